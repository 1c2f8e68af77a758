"""min |y - D c|^2 + lambda |c|_1, each answer with a certificate.

Dictionaries are learnt one room up.
"""
