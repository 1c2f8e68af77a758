"""What the inverse stages, score and sweep made, read back into types for score, show and report.

Truths are brought to the grid of a result here, because they come from files, too.
"""
