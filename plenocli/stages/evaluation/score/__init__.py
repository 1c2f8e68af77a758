"""score: results against the truth.

`run` scores each by its kind: `pictures` and spectra, `depth` and volumes, `designs` (calibrations
and dictionaries); what they are held against is a `comparison`.
"""
