"""Commands that look at results.

Parsing and printing only.
"""
