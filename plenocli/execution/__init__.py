"""How tasks run: pools of threads, processes or a cluster, batches of files, a journal of results.

What a task computes is not known here.
"""
