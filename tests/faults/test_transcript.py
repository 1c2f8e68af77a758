"""What plenocli says when it refuses, word for word: transcript.txt holds commands, their exit
codes and their messages.

A command may have a fault before it, as server.py knows them: [without MODULE], which is then not
installed, or [MODULE.FUNCTION ERROR n], a function that fails from its n-th call on. `pytest
tests/faults/test_transcript.py --new-transcript` writes the answers anew, for a person to read.
"""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from tests.faults.wrong_files import make_wrong_files
from tests.messages import shown_places

TRANSCRIPT = Path(__file__).with_name("transcript.txt")
ENTRIES = {
    part.partition("\n")[0].removeprefix("$ "): part.rstrip()
    for part in re.split(r"(?m)^(?=\$ )", TRANSCRIPT.read_text())
    if part
}


@pytest.fixture(scope="module")
def folder(stages, tmp_path_factory):
    """The small files of every kind, and beside them what is wrong in one way each."""
    source, _ = stages
    folder = tmp_path_factory.mktemp("transcript")
    for path in filter(Path.is_file, source.iterdir()):
        shutil.copy(path, folder)
    make_wrong_files(folder)
    return folder


def fault(words):
    """The fault of server.py that an entry's brackets name."""
    match words.split():
        case []:
            return {}
        case ["without", module]:
            return {"call": "without", "module": module}
        case [call, nth]:
            return {"call": call, "nth": int(nth)}
        case [call, error, nth]:
            module, _, name = call.rpartition(".")
            return {"call": name, "of": module, "error": error, "nth": int(nth), "lasting": True}


def answer(runner, folder, entry):
    """(the answer as the transcript keeps it, where its message was made)."""
    words, command = re.fullmatch(r"(?:\[(.*?)\] )?plenocli ?(.*)", entry).groups()
    before = set(folder.iterdir())
    outcome = runner.run(
        shlex.split(command), folder, limit=60, fault={"places": True, **fault(words or "")}
    )
    left = sorted(set(folder.iterdir()) - before)
    for path in left:
        path.unlink() if path.is_file() else shutil.rmtree(path)
    text = re.sub(r"Usage: .*\nTry .*\n\n", "", outcome.text).replace(str(folder), "FOLDER")
    text = re.sub(r"[\d.]+(?=[KMG]iB)", "#", text)  # what is needed changes with the laws of cost
    # a residual that is nothing but rounding, and a file as long as the digits of its figures
    text = re.sub(r"(?<=equations only to )[\d.e-]+", "#", text)
    text = re.sub(r"(?<=validation )[\d.]+(?= dB)", "#", text)  # by a step that is near rounding
    text = re.sub(r"\d+ bytes where \d+", "# bytes where #", text)
    text += f"\n(leaves {', '.join(path.name for path in left)})" if left else ""
    return f"$ {entry}\n[{outcome.code}] {text.rstrip()}\n", outcome.notes


def test_refusals_read_as_they_did(runner, folder, campaign, count, request):
    """By default every sixth."""
    anew = request.config.getoption("--new-transcript")
    answers, reached = {}, set()
    for entry in ENTRIES if anew else list(ENTRIES)[:: campaign(6, 1)]:
        answers[entry], notes = answer(runner, folder, entry)
        reached.update(notes.split())
    request.node.user_properties.append(("places", " ".join(reached)))
    if anew:
        TRANSCRIPT.write_text("\n".join(answers.values()))
    assert {entry: said.rstrip() for entry, said in answers.items()} == {
        entry: said.rstrip() if anew else ENTRIES[entry] for entry, said in answers.items()
    }
    assert not [
        said
        for said in answers.values()
        if not re.search(r"\n\[[2345]\] ", said) or "internal error" in said or "Traceback" in said
    ]
    count(
        "transcript of refusals",
        commands=len(answers),
        different_messages=len({a.partition("\n")[2] for a in answers.values()}),
        places_in_the_code=len(shown_places(reached)),
    )
