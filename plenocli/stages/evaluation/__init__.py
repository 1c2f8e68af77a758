"""The commands that look at results.

score, report, show, inspect, colorchecker.
"""
