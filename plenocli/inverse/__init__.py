"""The inverse problem: from captures back to grids, spectra, pictures, dictionaries and depth.

Arrays and types in and out; no files. It may use the forward model, never the other way round.
"""
