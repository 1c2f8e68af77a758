"""Pools: the same results from this process, threads and processes; workers that die; children
that go with their parent.
"""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import pytest

from plenocli.base.budget import Budget, budget, within
from plenocli.base.errors import InputError, UsageError
from plenocli.base.progress import collected_notes, note
from plenocli.execution import pool as pools
from plenocli.execution.pool import Lost, open_pool, run_all

HERE = "tests_scheduler_tasks"  # a module that processes find by its name
TASKS = """
import os, signal, time
from pathlib import Path
from plenocli.base.errors import InputError
from plenocli.base.progress import note

def square(n):
    note(f"squaring {n}")
    return n * n

def refuse(n):
    raise InputError("is odd", f"number {n}", "take another")

def memory(n):
    from plenocli.base.budget import budget
    return budget().memory

def fault(n):
    return 1 / 0

def threads(n):
    import numpy as np
    from threadpoolctl import threadpool_info
    return max(info["num_threads"] for info in threadpool_info() if info["user_api"] == "blas")

def die_once(path):
    if not Path(path).exists():
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"

def die(path):
    if path == "deadly":
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGKILL)
    return path

def sleep(path):
    Path(path, str(os.getpid())).touch()
    time.sleep(600)
"""


@pytest.fixture(scope="module")
def tasks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tasks")
    (folder / f"{HERE}.py").write_text(TASKS)
    sys.path.insert(0, str(folder))
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(folder), before]))
    import importlib

    yield importlib.import_module(HERE)
    sys.path.remove(str(folder))
    os.environ.pop("PYTHONPATH") if before is None else os.environ.update(PYTHONPATH=before)


def results(pool, function, numbers):
    return dict(run_all(pool, ((n, function, n) for n in numbers)))


def test_results_and_what_was_said_come_back_from_everywhere(tasks):
    for options in (dict(), dict(workers=3, threads=True), dict(workers=2)):
        with collected_notes() as said, open_pool(**options) as pool:
            assert results(pool, tasks.square, range(9)) == {n: n * n for n in range(9)}
            refused = results(pool, tasks.refuse, [5])[5]
        assert isinstance(refused, InputError) and str(refused) == "number 5: is odd; take another"
        if "threads" not in options:
            assert sorted(said) == [f"squaring {n}" for n in range(9)]


def test_a_task_has_the_budget_of_who_hands_it_in(tasks):
    for options in ({"workers": 1}, {"workers": 2}, {"workers": 2, "threads": True}):
        with within(Budget(12345)), open_pool(**options) as pool:
            assert results(pool, tasks.memory, range(3)) == {0: 12345, 1: 12345, 2: 12345}


def test_threads_without_a_task_serve_the_last_ones():
    """Two of four threads find no task: each of two that are left may use two, and the last all
    four; what is handed in afterwards has one, as what comes after the pool.
    """
    seen = {}
    done = {n: threading.Event() for n in range(6)}

    def task(n):
        if n > 3:  # until the ones before have ended
            done[n - 1 if n == 5 else 3].wait(10)
            deadline = time.monotonic() + 10
            while budget().threads < (2 if n == 4 else 4) and time.monotonic() < deadline:
                time.sleep(0.001)
        seen[n] = budget().threads

    with within(Budget(1 << 30)):
        with open_pool(4, threads=True) as pool:
            for n, _ in run_all(pool, ((n, task, n) for n in range(6))):
                done[n].set()
            pool.submit("next", task, 0)
            assert budget().threads == 1
            pool.next()
        assert budget().threads == 1
    assert (seen[4], seen[5]) == (2, 4)


def test_a_fault_of_ours_is_not_a_result(tasks):
    for workers in (1, 2):
        with pytest.raises(ZeroDivisionError), open_pool(workers) as pool:
            results(pool, tasks.fault, [1, 2])


def test_linear_algebra_has_one_thread_everywhere(tasks, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    for workers in (1, 2):
        with open_pool(workers) as pool:
            assert results(pool, tasks.threads, [0]) == {0: 1}
    assert os.environ["OMP_NUM_THREADS"] == "2"


def with_two_threads(code):
    """A process that ran the code, whose linear algebra starts with two threads."""
    threads = {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    return subprocess.run(
        [sys.executable, "-c", code], env=os.environ | threads, capture_output=True, text=True
    )


def test_a_library_that_is_loaded_by_a_task_has_one_thread():
    code = (
        "import numpy\n"
        "from threadpoolctl import threadpool_info\n"
        "from plenocli.execution.pool import open_pool\n"
        "import sys; assert 'scipy' not in sys.modules\n"
        "with open_pool():\n"
        "    import scipy.linalg\n"
        "    found = [i['num_threads'] for i in threadpool_info() if i['user_api'] == 'blas']\n"
        "print(len(found) > 1, max(found))"
    )
    done = with_two_threads(code)
    assert done.stdout.split() == ["True", "1"], done.stderr


def test_a_library_that_came_since_it_was_looked_for_has_one_thread():
    code = (
        "import numpy\n"
        "from threadpoolctl import threadpool_info\n"
        "from plenocli.base.budget import one_thread\n"
        "import sys; assert 'scipy' not in sys.modules\n"
        "with one_thread(): pass\n"
        "import scipy.linalg\n"
        "blas = lambda: [i['num_threads'] for i in threadpool_info() if i['user_api'] == 'blas']\n"
        "with one_thread(): inside = blas()\n"
        "print(len(inside) > 1, max(inside), *set(blas()))"
    )
    done = with_two_threads(code)
    assert done.stdout.split() == ["True", "1", "2"], done.stderr


def test_a_process_that_dies_takes_no_result_along(tasks, tmp_path):
    with open_pool(2) as pool:
        jobs = [(n, tasks.square, n) for n in range(4)]
        found = dict(
            run_all(
                pool,
                [
                    *jobs,
                    ("x", tasks.die_once, str(tmp_path / "x")),
                    *((n + 4, f, n + 4) for n, f, _ in jobs),
                ],
            )
        )
    assert found == {n: n * n for n in range(8)} | {"x": "alive"}


def test_tasks_may_be_handed_in_while_processes_die(tasks, tmp_path):
    """The pool learns of the death between two tasks, not while it waits for one."""
    with open_pool(2) as pool:
        pool.submit("first", tasks.die_once, str(tmp_path / "x"))
        deadline = time.monotonic() + 60
        while not (tmp_path / "x").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(1.0)
        pool.submit("second", tasks.square, 3)
        assert dict([pool.next(), pool.next()]) == {"first": "alive", "second": 9}


def test_a_task_that_kills_every_process_is_lost_alone(tasks):
    with open_pool(2) as pool:
        found = dict(
            run_all(pool, [(name, tasks.die, name) for name in ("a", "b", "deadly", "c", "d")])
        )
    assert isinstance(found.pop("deadly"), Lost) and found == {name: name for name in "abcd"}


def test_processes_go_with_their_parent(tasks, tmp_path):
    code = (
        f"import {HERE}; from plenocli.execution.pool import open_pool, run_all\n"
        "if __name__ == '__main__':\n"
        f"    with open_pool(2) as pool: list(run_all(pool, [(n, {HERE}.sleep, "
        f"{str(tmp_path)!r}) for n in (1, 2)]))"
    )
    script = tmp_path / "main.py"
    script.write_text(code)
    parent = subprocess.Popen([sys.executable, script], start_new_session=True)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and len([p for p in os.listdir(tmp_path) if p.isdigit()]) < 2:
        time.sleep(0.05)
    children = [int(p) for p in os.listdir(tmp_path) if p.isdigit()]
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    while time.monotonic() < deadline and any(map(_lives, children)):
        time.sleep(0.05)
    assert len(children) == 2 and not any(map(_lives, children))


def _lives(pid):
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_few_results_wait(tasks):
    """Tasks are handed in as results are taken, not all at once."""
    taken = []

    def jobs():
        for n in range(50):
            assert n - len(taken) <= 6
            yield n, tasks.square, n

    with open_pool(2) as pool:
        for token, _ in run_all(pool, jobs()):
            taken.append(token)
    assert sorted(taken) == list(range(50))


def test_what_is_said_is_heard_by_this_thread_only(capsys):
    with collected_notes() as said:
        note("one")
    note("two")
    assert said == ["one"] and capsys.readouterr().err == "plenocli: two\n"


def test_a_scheduler_that_goes_while_tasks_are_given_up_is_no_bug(monkeypatch):
    """Dask then says so of `cancel`, at the end."""
    distributed = pytest.importorskip("distributed")
    from distributed.client import ClosedClientError

    class Client:
        def __init__(self, *_, **__):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def nthreads(self):
            return {1: 1}

        def get_executor(self, **_):
            return self

        def shutdown(self, **_):
            raise ClosedClientError("Client is closed. Can't send cancel-keys message.")

    monkeypatch.setattr(distributed, "Client", Client)
    with pytest.raises(Lost, match="run again"), open_pool(1, "tcp://127.0.0.1:1"):
        pass


@pytest.mark.parametrize("address", ["nowhere", "tcp://127.0.0.1:1"])
def test_a_cluster_that_is_not_there_is_a_usage_error(address, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(pools, "PATIENCE", "1s")
    with pytest.raises(UsageError, match="scheduler"), open_pool(1, address):
        pass


@pytest.mark.parametrize(
    "options",
    ["?ca=nowhere.pem", "?ca=ca.pem", "?password=ca.pem", "?ca", "tcp://127.0.0.1:1?ca=ca.pem"],
)
def test_options_of_an_address_are_files_of_tls(options, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ca.pem").write_text("x")
    address = options if "://" in options else f"tls://127.0.0.1:1{options}"
    with pytest.raises(UsageError, match="files? of TLS"), open_pool(1, address):
        pass


def certificates(folder):
    """Options of an address whose files openssl makes."""
    for name in ("own", "other"):
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"]
            + ["-nodes", "-keyout", f"{name}.key", "-out", f"{name}.pem", "-days", "2"]
            + ["-subj", "/CN=plenocli"],
            cwd=folder,
            check=True,
            capture_output=True,
        )
    return {
        name: f"ca={folder}/own.pem,cert={folder}/{name}.pem,key={folder}/{name}.key"
        for name in ("own", "other")
    }


@pytest.mark.skipif(not shutil.which("openssl"), reason="needs openssl")
@pytest.mark.filterwarnings("default")  # what Dask's own threads warn of is not ours
def test_a_cluster_behind_tls_takes_the_files_of_its_address_and_no_others(tasks, tmp_path):
    distributed = pytest.importorskip("distributed")
    options = certificates(tmp_path)
    own = dict(part.split("=") for part in options["own"].split(","))
    names = {"tls_ca_file": own["ca"], "require_encryption": True}
    for role in ("scheduler", "worker", "client"):
        names |= {f"tls_{role}_cert": own["cert"], f"tls_{role}_key": own["key"]}
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tls://",
        dashboard_address=None,
        security=distributed.Security(**names),
    ) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        with open_pool(1, f"{address}?{options['own']}") as pool:
            assert results(pool, tasks.square, [3]) == {3: 9}
        for wrong, said in (("", "needs the files"), (f"?{options['other']}", "answers")):
            with pytest.raises(UsageError, match=said), open_pool(1, address + wrong):
                pass


def test_partial_functions_travel(tasks):
    with open_pool(2) as pool:
        assert dict(run_all(pool, [(0, partial(pow, 3), 4)])) == {0: 81}


def test_a_worker_without_what_the_task_needs_is_told_to_install_it():
    from plenocli.execution.pool import _trouble

    error = _trouble(ModuleNotFoundError("No module named 'plenocli'"))
    assert (
        isinstance(error, UsageError)
        and "cannot load the task (No module named 'plenocli')" in str(error)
        and "install" in error.fix
    )
