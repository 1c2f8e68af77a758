"""How good a result is: results against truths, spectra against spectra, one
response against another.

Arrays and types in, numbers out; pages are report.
"""
