"""How much memory a child process has held."""

PEAK = (
    "next(int(line.split()[1]) for line in open('/proc/self/status') if line.startswith('VmHWM'))"
)
"""An expression, for the child to evaluate: its highest resident memory so far, KiB. getrusage
would count the process that forked it.
"""
