"""Commands that explore a design space.

Parsing and printing only.
"""
