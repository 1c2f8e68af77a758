"""The command line: one file a command, which parses, calls its stage and prints one line.

No mathematics and no files.
"""
