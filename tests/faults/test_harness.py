"""The harness itself: it sees codes, signals, hangs and faults."""

import signal

from tests.faults.harness import is_clean_refusal


def test_codes_signals_and_hangs_are_told_apart(runner, stages):
    folder, _ = stages
    assert runner.run(["inspect", "pif.h5"], folder).code == 0
    missing = runner.run(["inspect", "none.h5"], folder)
    assert is_clean_refusal(missing, 3, "none.h5") and not missing.hung
    assert not is_clean_refusal(missing, 4) and not is_clean_refusal(missing, 3, "other.h5")
    killed = runner.run(["inspect", "pif.h5"], folder, kill_after=0.0)
    assert killed.code == -signal.SIGKILL and not killed.hung
    assert runner.run(["inspect", "pif.h5"], folder, limit=0.0).hung


def test_every_kind_of_artefact_is_among_the_samples(stages):
    from plenocli.files.artefacts.kinds import SCHEMAS
    from plenocli.files.artefacts.reading import read_artefact

    folder, _ = stages
    kinds = {read_artefact(path).kind for path in folder.glob("*.h5")}
    assert kinds == set(SCHEMAS)
