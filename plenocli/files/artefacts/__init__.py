"""HDF5 artefacts: one schema table a kind, one writer, one verified reader.

Pictures and RAW files are images.
"""
