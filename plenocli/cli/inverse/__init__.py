"""Commands that turn captures into results.

Parsing and printing only.
"""
