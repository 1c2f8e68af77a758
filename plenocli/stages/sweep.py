"""sweep and optimise: many cameras through the chain, what each gives as one table, and the front of those that none beats."""

import contextlib
import csv
import io
import json
import shutil
import tomllib
from collections import deque
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from plenocli.errors import ConfigError, InputError, NumericsError, OutputError, PlenoError, UsageError
from plenocli.plain import plain
from plenocli.stages.chain import CHAINS, DESIGN, matrix_key, point_key, refused, run_matrix, run_point, task_of
from plenocli.stages.progress import bar, note
from plenocli.stages.scheduler import Lost, open_pool

FRONTS = {"spatial": {"psnr_db": "max", "sensor_pixels": "min"}, "spectral": {"six_patch_rmse": "min", "lenslet_field_m": "min"}}
"""What counts as better where the file does not say."""
_FILES = ("aperture_image", "wavefront", "prescription")
_EXTERNAL = ("scene", "dictionary", "training")
"""Options that may name files."""


@dataclass
class Row:
    """A point: its number, values by key, task with its keys, and what came of it."""

    number: int
    point: dict
    task: dict | None = None
    key: str = ""
    matrix: str = ""
    camera: object = None
    result: dict | None = None


@dataclass
class Space:
    """A sweep file with all that it names: the description, its axes, the camera it starts from and how options are read."""

    path: Path
    sweep: object
    axes: dict
    chain: str
    base: dict
    camera_path: Path
    read_options: object
    seed: int
    files: dict = field(default_factory=dict)

    def row(self, number, point):
        """The Row of a point; refused already where no such camera can be."""
        from plenocli.config.sweep import changed, options_of

        options = {stage: self.read_options(stage, self._located(values)) for stage, values in options_of(self.sweep, point).items()}
        self._remember(options)
        row = Row(number, point)
        try:
            row.camera = self._camera(changed(self.base, {**self.sweep.set, **point}, self.sweep.follow))
        except ConfigError as error:
            row.result = refused(error)
            row.key = point_key({"refused": point, "options": _jsonable(options), "base": self.base, "chain": self.chain}, self.files)
            return row
        row.task = task_of(self.chain, row.camera, _jsonable(options), self.seed)
        row.key, row.matrix = point_key(row.task, self.files), matrix_key(row.task, row.camera, self.files)
        return row

    def _camera(self, data):
        from pydantic import ValidationError

        from plenocli.config.camera import Camera, violations

        lens = data.get("main_lens")
        if isinstance(lens, dict):
            for name in _FILES:
                if isinstance(lens.get(name), str):
                    lens[name] = self._digested((self.camera_path.parent / lens[name]).resolve())
        try:
            return Camera.model_validate(data)
        except ValidationError as error:
            raise violations(error, "camera") from None

    def _digested(self, path):
        from plenocli.artefacts import file_digest

        if str(path) not in self.files:
            self.files[str(path)] = file_digest(path)
        return str(path)

    def _located(self, values):
        """Options whose files, named relative to the sweep file, are found from anywhere."""
        def place(value):
            if isinstance(value, list):
                return [place(v) for v in value]
            known = isinstance(value, str) and (self.path.parent / value).is_file()
            return str((self.path.parent / value).resolve()) if known else value

        return {name: place(value) if name in _EXTERNAL else value for name, value in values.items()}

    def _remember(self, options):
        for values in options.values():
            for name in _EXTERNAL:
                for value in np.ravel(values.get(name) or []):
                    if Path(str(value)).is_file():
                        self._digested(Path(str(value)))


def open_space(path, read_options, seed=0):
    """The Space of the sweep file at `path`. read_options(stage, values): option -> value of a stage as its command line reads them;
    UsageError. Errors: InputError for files, ConfigError for what they say."""
    from plenocli.config.camera import read_text
    from plenocli.config.sweep import STAGES, load_sweep

    path = Path(path)
    sweep, axes = load_sweep(path)
    camera_path = path.parent / sweep.camera
    try:
        base = tomllib.loads(read_text(camera_path, "camera"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is not TOML: {error}", camera_path, "mend the line") from None
    chain = sweep.chain or ("spectral" if "filter_array" in base else "spatial")
    named = [*sweep.options, *(head for key in [*sweep.varied, *sweep.set] if (head := key.partition(".")[0]) in STAGES)]
    for stage in named:
        if stage not in CHAINS[chain]:
            raise ConfigError(f"{stage} is no stage of the {chain} chain ({', '.join(CHAINS[chain])})", path, f"leave it out, or set chain = \"{'spatial' if chain == 'spectral' else 'spectral'}\"")
    return Space(path, sweep, axes, chain, base, camera_path, read_options, seed)


def run_sweep(path, output, *, read_options, seed=0, workers=1, scheduler=None, mem_limit=None, plot=None, overwrite=False, command=""):
    """Carry every point of the design through the chain and write the table `output` (.h5), the same as .csv, and perhaps the
    front as a picture; returns a summary dict.

    Finished points lie in the folder OUT.parts and are never computed again, whatever ended the run. A point that a stage refuses
    is a row with the reason. workers, scheduler: see stages.scheduler; mem_limit: bytes that a stage may plan for, in each of them. Errors: as open_space; UsageError for the front,
    OutputError where nothing can be written or a worker was lost.
    """
    from plenocli.config.sweep import points

    space = open_space(path, read_options, seed)
    rows = [space.row(number, point) for number, point in enumerate(points(space.sweep, space.axes, seed))]
    objectives = objectives_of(space, rows)
    with open_store(output, plot, overwrite, [path, space.camera_path]) as store, open_pool(workers, scheduler) as pool:
        computed = store.evaluate(rows, pool, list(space.files), mem_limit)
        return finish(space, rows, objectives, store, computed, command)


# --- working through points ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def open_store(output, plot, overwrite, inputs):
    """The Store of results beside `output`, checked before any work."""
    from plenocli.artefacts import check_output

    output = Path(output)
    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".h5",))
    folder = output.with_suffix(".parts")
    again = overwrite or folder.is_dir()  # what an unfinished run left is ours
    check_output(output.with_suffix(".csv"), overwrite=again, inputs=inputs)
    if plot is not None:
        if find_spec("matplotlib") is None:
            raise UsageError("pictures need matplotlib, which is not installed", "--plot", "pip install 'plenocli[plot]', or leave it out")
        check_output(plot, overwrite=again, inputs=inputs, suffixes=(".png",))
    store = Store(folder, output, plot, overwrite, again)
    try:
        yield store
    finally:
        store.close()


class Store:
    """Results by content key in the folder beside OUT: points.jsonl, and while they are needed the matrices that points share."""

    def __init__(self, folder, output, plot=None, overwrite=False, again=False):
        from plenocli.stages.journal import Journal

        self.folder, self.output, self.plot, self.overwrite, self.again = folder, output, plot, overwrite, again
        try:
            folder.mkdir(exist_ok=True)
            self.journal = Journal(folder / "points.jsonl")
            shutil.rmtree(folder / "scratch", ignore_errors=True)
            for name in ("scratch", "matrices"):
                (folder / name).mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot be made ({error.strerror})", folder, "check the folder and its permissions") from None

    def close(self):
        """Let go of the folder; scratch files go."""
        shutil.rmtree(self.folder / "scratch", ignore_errors=True)
        self.journal.close()

    def evaluate(self, rows, pool, files=(), mem_limit=None, label="points"):
        """Give every row its result, from the journal or through `pool`; returns the number of points computed.

        Rows of one content key are computed once, a matrix that several need is computed once, before them. files: what tasks
        read; mem_limit: as run_sweep; what was refused under another limit is tried again. OutputError at the end where a worker was lost: all others are done then.
        """
        todo = {}
        for row in rows:
            known = self.journal.records.get(row.key)
            if row.task is not None and row.key not in todo and (known is None or (known["status"] == 5 and known.get("mem_limit") != mem_limit)):
                todo[row.key] = row
        groups = {}
        for row in todo.values():
            groups.setdefault(row.matrix, []).append(row)
        with bar(None, len(todo), label) as progress:
            scratch = None if pool.far else str((self.folder / "scratch").resolve())
            lost = _Work(self, groups, pool, {"scratch": scratch, "files": list(files), "mem_limit": mem_limit}).run(progress)
        if lost:
            raise OutputError(f"{len(lost)} of {len(todo)} points have no result: {lost[0]}", self.output, "the others are kept; run the command again")
        for row in rows:
            if row.task is not None:
                row.result = self.journal.records[row.key]
        return len(todo)


class _Work:
    """Points through a pool, those of one matrix after it; at most as many matrices lie on the disk as are in use."""

    def __init__(self, store, groups, pool, surroundings):
        self.store, self.pool, self.surroundings = store, pool, surroundings
        self.groups, self.waiting, self.ready = {key: list(rows) for key, rows in groups.items()}, deque(groups), deque()
        self.left = {key: len(rows) for key, rows in groups.items()}
        self.lost, self.running = [], 0

    def run(self, progress):
        """Do everything; returns the errors of what was lost."""
        while True:
            while self.pool.room and (self.ready or self.waiting):
                if not self.ready:
                    self._open(self.waiting.popleft())
                self.pool.submit(*self.ready.popleft())
                self.running += 1
            if not self.running:
                return self.lost
            (kind, key, row), result = self.pool.next()
            self.running -= 1
            if isinstance(result, Lost):
                self.lost += [result] * (1 if kind == "point" else len(self.groups[key]))
            elif isinstance(result, OutputError):
                raise result
            elif kind == "matrix":
                progress.update(self._matrix(key, result))
            else:
                self._done(key, row, result)
                progress.update()

    def _open(self, key):
        """Make the first tasks of a group ready: its matrix, or its points where that lies there or serves one alone."""
        rows, path = self.groups[key], self._path(key)
        info = self.store.journal.records.get(f"matrix {key}")
        if info is not None and path.is_file():
            self._points(key, str(path.resolve()), info)
        elif len(rows) > 1:
            self.ready.append((("matrix", key, None), run_matrix, rows[0].task | self.surroundings))
        else:
            self._points(key, None, None)

    def _points(self, key, path, info):
        for row in self.groups[key]:
            self.ready.append((("point", key, row), run_point, row.task | self.surroundings | {"matrix": path, "info": info}))

    def _matrix(self, key, result):
        """Keep a matrix and make its points ready, or refuse them all; returns how many were refused."""
        from plenocli.artefacts import publish

        if isinstance(result, PlenoError):
            for row in self.groups[key]:
                self._done(key, row, refused(result))
            return len(self.groups[key])
        publish(self._path(key), result["content"], overwrite=True)
        self.store.journal.add(f"matrix {key}", result["info"])
        self._points(key, str(self._path(key).resolve()), result["info"])
        return 0

    def _done(self, key, row, result):
        if isinstance(result, PlenoError):
            result = refused(result)
        self.store.journal.add(row.key, result | {"mem_limit": self.surroundings["mem_limit"]})
        self.left[key] -= 1
        if not self.left[key]:
            self._path(key).unlink(missing_ok=True)

    def _path(self, key):
        return self.store.folder / "matrices" / f"{key}.h5"


# --- the table ----------------------------------------------------------------------------------------------------------


def _definitions():
    from plenocli.metrics import classify, quality, snr, spectral

    return {name: text for module in (quality, spectral, snr, classify) for name, text in module.DEFINITIONS.items()} | DESIGN


def objectives_of(space, rows):
    """Metric or numeric key -> "max" or "min"; ConfigError for a name that no point can have."""
    import difflib

    from plenocli.config.sweep import number

    wanted = space.sweep.front or FRONTS[space.chain]
    numeric = [key for key in space.sweep.varied if rows and all(number(row.point.get(key)) is not None for row in rows)]
    known = [*_definitions(), *numeric]
    for name in wanted:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            raise ConfigError(f"front.{name}: no metric of that name; " + (f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"), space.path)
    return dict(wanted)


def _columns(space, rows):
    """(parameters, metrics, values (point, parameter), figures (point, metric)): dicts that describe the columns, NaN where there is nothing."""
    from plenocli.config.sweep import number, unit

    parameters, values = [], []
    for key in space.sweep.varied:
        given = [row.point.get(key) for row in rows]
        numbers = [None if value is None else number(value) for value in given]
        if all(value is None or n is not None for value, n in zip(given, numbers)):
            parameters.append({"key": key, "unit": next((unit(v) for v in given if v is not None), "")})
            values.append([np.nan if n is None else n for n in numbers])
        else:
            choices = list({json.dumps(v): v for v in given if v is not None}.values())
            parameters.append({"key": key, "unit": "", "choices": choices})
            values.append([np.nan if v is None else next(i for i, c in enumerate(choices) if c == v and type(c) is type(v)) for v in given])
    names = dict.fromkeys(name for row in rows for name in row.result["metrics"])
    order = [*(name for name in names if name not in DESIGN), *(name for name in DESIGN if name in names)]
    known = _definitions()
    figures = [[np.nan if (v := row.result["metrics"].get(name)) is None else v for name in order] for row in rows]
    return (parameters, [{"name": name, "meaning": known.get(name, "")} for name in order],
            np.array(values, float).reshape(len(values), len(rows)).T, np.array(figures, float).reshape(len(rows), len(order)))


def finish(space, rows, objectives, store, computed, command):
    """Write table, CSV and picture; returns the summary. The error of the first point is raised where no point worked."""
    from plenocli.artefacts import Artefact, Provenance, describe_inputs, publish, write_artefact
    from plenocli.metrics.pareto import front

    parameters, metrics, values, figures = _columns(space, rows)
    names = [m["name"] for m in metrics]
    keys = [p["key"] for p in parameters]
    merit = [figures[:, names.index(n)] if n in names else values[:, keys.index(n)] if n in keys else np.full(len(rows), np.nan) for n in objectives]
    status = np.array([row.result["status"] for row in rows])
    ahead = front(np.where(status[:, None] == 0, np.array(merit).T, np.nan), [1 if way == "max" else -1 for way in objectives.values()])
    reasons = {str(row.number): row.result["reason"] for row in rows if row.result["status"]}
    remarks = {str(row.number): row.result["notes"] for row in rows if row.result["notes"]}
    attrs = {"chain": space.chain, "parameters": parameters, "metrics": metrics, "objectives": list(objectives.items()), "reasons": reasons, "notes": remarks,
             "description": plain(space.sweep.model_dump(by_alias=True, exclude_none=True))}
    data = {"sweep/parameter": values, "sweep/metric": figures if names else None, "sweep/status": status.astype(np.int32), "sweep/front": ahead,
            "sweep/key": np.array([row.key for row in rows], dtype="S64")}
    inputs = {"sweep": space.path, "camera": space.camera_path, "file": sorted(space.files) or None}
    provenance = Provenance(command, describe_inputs(inputs), space.seed, _base_text(space))
    publish(store.output.with_suffix(".csv"), _csv(rows, keys, names, figures, ahead).encode(), overwrite=store.again)
    artefact = Artefact("sweep", data, {"sweep": attrs}, provenance)
    if store.plot is not None and not ahead.any():
        note("no point has all figures of the front: there is nothing to draw")
    elif store.plot is not None:
        from plenocli.report.front import front_picture

        publish(store.plot, front_picture(artefact), overwrite=store.again)
    write_artefact(store.output, artefact, overwrite=store.overwrite)
    shutil.rmtree(store.folder / "matrices", ignore_errors=True)
    if not (status == 0).any():
        worst = max((row for row in rows), key=lambda row: row.result["status"])
        raise _CLASSES[worst.result["status"]](f"none of {len(rows)} points could be computed; the first: {rows[0].result['reason']}", space.path, f"{store.output} holds all reasons")
    best = sorted(np.flatnonzero(ahead), key=lambda i: tuple(-m[i] if way == "max" else m[i] for m, way in zip(merit, objectives.values())))
    shown = [{"point": rows[i].number, **{name: float(m[i]) for name, m in zip(objectives, merit) if name not in keys}, **rows[i].point} for i in best]
    return {"output": str(store.output), "points": len(rows), "computed": computed, "refused": len(reasons), "with_remarks": len(remarks), "first_reason": next(iter(reasons.values()), ""), "first_remark": next(iter(remarks.values()), [""])[0], "objectives": objectives,
            "front": shown, "cpu_seconds": sum(row.result["seconds"] for row in rows)} | ({"plot": str(store.plot)} if store.plot is not None and ahead.any() else {})


_CLASSES = {error.exit_code: error for error in (ConfigError, InputError, NumericsError)}


def _base_text(space):
    """The camera that all points start from, as resolved TOML; as it stands where it is no camera before something is put in."""
    from plenocli.config.camera import parse_camera

    text = space.camera_path.read_text(encoding="utf-8")
    try:
        return parse_camera(text, space.camera_path).text
    except ConfigError:
        return text


def _csv(rows, keys, names, figures, ahead):
    """The table as text: values as they stand in the sweep file, figures to the last digit, nothing for what is not there."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["point", *keys, "status", "front", *names, "reason"])
    for i, row in enumerate(rows):
        shown = [v if isinstance(v, (str, int, float)) and not isinstance(v, bool) else "" if v is None else json.dumps(v) for v in (row.point.get(key) for key in keys)]
        writer.writerow([row.number, *shown, row.result["status"], int(ahead[i]), *("" if np.isnan(v) else repr(float(v)) for v in figures[i]),
                         " ".join(row.result["reason"].split())])
    return out.getvalue()


def _jsonable(options):
    """Options as JSON keeps them: paths as text, tuples as lists."""
    return plain(options)


def lines(report):
    """What run_sweep did, for people: a sentence, and the front as a table, at most twenty rows of it."""
    aims = ", ".join(f"{name} {way}" for name, way in report["objectives"].items())
    text = [f"{report['output']}: {report['points']} points, {report['computed']} computed now, {report['refused']} refused; {len(report['front'])} on the front of {aims}"]
    for count, what, said in ((report["refused"], "refused", report["first_reason"]), (report["with_remarks"], "with remarks of the stages", report["first_remark"])):
        if count:
            text.append(f"  {count} {what}, the first: {' '.join(said.split())[:200]}")
    if report["front"]:
        heads = list(report["front"][0])
        cells = [heads] + [[f"{v:.6g}" if isinstance(v, float) else str(v) for v in (entry.get(h, "") for h in heads)] for entry in report["front"][:20]]
        widths = [max(len(row[i]) for row in cells) for i in range(len(heads))]
        text += ["  " + "  ".join(c.rjust(w) for c, w in zip(row, widths)) for row in cells]
        if len(report["front"]) > 20:
            text.append(f"  and {len(report['front']) - 20} more")
    return "\n".join(text)
