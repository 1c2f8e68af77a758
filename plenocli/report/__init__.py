"""Pictures and pages about results.

Figures are computed in evaluation.
"""
