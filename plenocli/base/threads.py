"""Work on several threads, and linear algebra kept on the one that asks for it."""


def one_thread():
    """A context in which products and decompositions of matrices stay on the thread that asks for
    them: idle threads that wait for the next product cost many times its processor time.
    """
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1, "blas")


def spread(parts, work, workers):
    """work(*part) for all parts on `workers` threads."""
    with one_thread():
        if workers <= 1 or len(parts) < 2:
            for part in parts:
                work(*part)
            return
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor(workers) as pool:
            for done in [pool.submit(work, *part) for part in parts]:
                done.result()
