"""What everything rests on: errors, units, text, memory, threads, progress, random streams,
linear maps, tiling.

Nothing here knows a camera, a file format or a command.
"""
