"""A page in which results are looked at: focus, views, spectra, slices, comparisons.

`panels` says what is shown of a file, `page` packs it; script and style are beside them.
"""
