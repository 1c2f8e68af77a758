"""One file a command: read files, call the rooms below, write files.

No mathematics and no parsing of command lines.
"""
