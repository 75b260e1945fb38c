"""Read an input, run its steps in order, hand back what they found."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import json
import pkgutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from graphlib import TopologicalSorter
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import processor
from processor import diagnostics, user_methods
from processor.model import InputError, Reason, Scan, Scene, Status, StepRun, UsageError, did_you_mean, inputs, reason
from processor.model.doubted import doubted
from processor.plain_text import tomllib
from processor.progress import stage
from processor.store import epoch
from processor.store.json_values import json_ready
from processor.version import __version__

PIECEWISE_POINTS = 5_000_000  # work, not result: 5 million points are 120 MB, and steps hold several times as much
SAMPLED_TILES = 64  # of all scans of a scene file, a million points: where these are used once, all are
SOFTWARE = ("numpy", "scipy", "h5py")


@dataclass(frozen=True)
class Job:
    """One step with its parameters."""

    step: str
    module: ModuleType
    params: Any
    function: Callable[..., Any] | None = None  # of a method of the user's own, instead of the module's ``run``

    @property
    def method(self) -> str:
        """The name of the method in results."""
        return user_methods.shown(self.params.method)


@dataclass(frozen=True)
class StepCloud:
    """A cloud of a stage of a step, by the step's method."""

    step: str
    method: str
    cloud: diagnostics.KeptCloud


@dataclass(frozen=True)
class Execution:
    """What was run on which scene, and everything that made the result."""

    scene: Scene
    runs: tuple[StepRun, ...]  # the result of each step first, then other methods for comparison
    provenance: dict[str, Any]
    stored: Path | None = None  # the scene's file, where its points are still in it
    clouds: tuple[StepCloud, ...] = ()  # of the steps' stages, where they were asked for

    def by_step(self) -> list[tuple[StepRun, list[StepRun]]]:
        """Pair the first run of each step, its result, with the runs of other methods for comparison."""
        by_step: dict[str, tuple[StepRun, list[StepRun]]] = {}
        for run in self.runs:
            if run.step in by_step:
                by_step[run.step][1].append(run)
            else:
                by_step[run.step] = (run, [])
        return list(by_step.values())


@cache
def step_modules() -> dict[str, ModuleType]:
    """All steps by name: the module ``step`` of each package of processor that has one, with the step's NAME."""
    packages = [found.name for found in pkgutil.iter_modules(processor.__path__) if found.ispkg]
    modules = [
        importlib.import_module(f"processor.{package}.step")
        for package in packages
        if importlib.util.find_spec(f"processor.{package}.step")
    ]
    return {module.NAME: module for module in sorted(modules, key=lambda module: str(module.NAME))}


def package_of(step: str) -> str:
    """Return the name of a step's package; its report and its evaluation have the same."""
    return step_modules()[step].__name__.split(".")[1]


def module_of(folder: str, step: str) -> ModuleType | None:
    """Return the module of a step in a folder of processor, named as the step's package; None where there is none."""
    name = f"processor.{folder}.{package_of(step)}"
    return importlib.import_module(name) if importlib.util.find_spec(name) else None


def result_classes() -> dict[str, type]:
    """Return the Result record of every step, by the step's name."""
    return {name: module.Result for name, module in step_modules().items()}


def read(
    path: Path, units: str | None, piecewise: bool = False, keep: Callable[[Scan], Scan] = lambda scan: scan
) -> Scene:
    """Read a scan folder, a scene file or one scan file; InputError where it cannot be used.

    ``piecewise`` leaves the points of a scene file where they are, for steps that take them piece by piece. Scans of
    other files go through ``keep``, see :func:`processor.scan_folder.folder.read_input`.
    """
    from processor import readers
    from processor.scan_folder import folder
    from processor.store import store

    if path.is_file() and path.suffix.lower() == ".h5":
        if units is not None:
            raise UsageError(f"--units {units}: {path.name} is a scene file, which knows its units; leave --units out")
        scene = store.read_scene(path, not piecewise)
    else:
        scene = folder.read_input(path, units, keep)
        if sum(len(scan.points) for scan in scene.scans) > PIECEWISE_POINTS:
            readers.sandbox.close()  # its process takes memory that the steps need
    for name in (path.name, scene.name, *(scan.name for scan in scene.scans)):
        try:
            name.encode("utf-8")
        except UnicodeEncodeError:
            raise InputError(f"{name!a}: a file name that is not UTF-8; rename the file") from None
    return scene


def is_large(path: Path) -> bool:
    """Whether a scene file holds more points than are read into memory at once where that is not needed.

    Points of which some coincide are read at once, as they are to count once.
    """
    from processor.geometry import coincident_points
    from processor.store.streaming import points_of

    if not (path.is_file() and path.suffix.lower() == ".h5"):
        return False
    with points_of(path) as points:
        if sum(points.counts()) <= PIECEWISE_POINTS:
            return False
        return not any(coincident_points.used_once(sample) is not None for sample in points.samples(SAMPLED_TILES))


def read_params(path: Path | None) -> dict[str, Any]:
    """Read a parameter file: a table per step. UsageError where it is not TOML."""
    if path is None:
        return {}
    try:
        found: dict[str, Any] = tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(f"{path}: not a readable parameter file: {error}") from error
    return found


def steps_for(scene: Scene) -> tuple[str, ...]:
    """Name the steps that run by themselves on a scene: those whose module ``applies``, or whose KIND is the scene's.

    Raises UsageError where there are none.
    """
    modules = step_modules()
    found = tuple(name for name, module in modules.items() if _applies(module, scene))
    if not found:
        raise UsageError(f"{_nothing_to_do(scene)}; the steps are {', '.join(modules)}")
    return found


def _nothing_to_do(scene: Scene) -> str:
    """Say why no step runs by itself, and the line that leads to one."""
    if scene.kind == "structure" and scene.structure is None and len(scene.scans) == 1:
        return (
            f"{scene.name}: one scan without a design, so no step runs by itself: for a sphere target or balls add "
            "--steps spheres; to compare it with a design put that beside it and run processor init; to compare it "
            "with another scan: processor compare REFERENCE COMPARED -o OUT"
        )
    return f"{scene.name}: no step runs by itself on this scene of kind {scene.kind}; name one with --steps"


def jobs_for(
    scene: Scene, wanted: Sequence[str], methods: Sequence[str], params: Mapping[str, Any], seed: int | None
) -> tuple[Job, ...]:
    """Plan the steps ``wanted``, or those that run by themselves on a scene; raises UsageError as :func:`plan` does.

    A step whose module names steps as ``needed`` on the scene runs with them.
    """
    modules = step_modules()
    chosen = wanted or steps_for(scene)
    needs = [_needed(modules[name], scene) for name in chosen if name in modules]
    return plan((*chosen, *(name for of_step in needs for name in of_step)), methods, params, seed)


def prepare(
    path: Path,
    units: str | None,
    wanted: Sequence[str],
    methods: Sequence[str],
    params: Mapping[str, Any],
    seed: int | None,
) -> tuple[Scene, tuple[Job, ...], bool]:
    """Read an input and plan its steps; also whether its points stay in the file, to be read piece by piece."""
    piecewise = is_large(path)
    scene = read(path, units, piecewise)
    jobs = jobs_for(scene, wanted, methods, params, seed)
    if piecewise and not (
        all(job.params.method in getattr(job.module, "STREAMS", ()) for job in jobs) and scene.target_search is None
    ):
        return read(path, units), jobs, False
    return scene, jobs, piecewise


def _applies(module: ModuleType, scene: Scene) -> bool:
    applies: Callable[[Scene], bool] | None = getattr(module, "applies", None)
    return scene.kind == module.KIND if applies is None else applies(scene)


def _needed(module: ModuleType, scene: Scene) -> tuple[str, ...]:
    needed: Callable[[Scene], tuple[str, ...]] | None = getattr(module, "needed", None)
    return () if needed is None else needed(scene)


def plan(wanted: Sequence[str], methods: Sequence[str], params: Mapping[str, Any], seed: int | None) -> tuple[Job, ...]:
    """Put steps in the order of their needs, with their methods; every name and type is checked.

    The first method named for a step gives the result; further ones are run for comparison. A method of the user's own,
    ``module:function``, is of the one step that is run. Without a ``seed`` that of the parameters holds. Raises
    UsageError for whatever is not known, saying what is.
    """
    modules = step_modules()
    chosen = list(dict.fromkeys(wanted))
    for name in (*chosen, *params):
        if name not in modules:
            raise UsageError(f"no step {name!r}{did_you_mean(name, modules)}; there are {', '.join(modules)}")
    chosen = _in_order(chosen, modules)
    if len(chosen) > 1 and (own := next(filter(user_methods.is_named, methods), None)):
        raise UsageError(
            f"method {own!r}: expected one step that it is of, named with --steps; got {', '.join(chosen)}"
        )
    offered = {name: [m for m in methods if m in modules[name].METHODS or user_methods.is_named(m)] for name in chosen}
    for method in methods:
        if not any(method in named for named in offered.values()):
            known = "; ".join(f"{name}: {', '.join(modules[name].METHODS)}" for name in chosen)
            like = did_you_mean(method, [one for name in chosen for one in modules[name].METHODS])
            raise UsageError(f"no method {method!r} for these steps{like} ({known})")
    # Tables of steps that do not run are checked too: one file serves many inputs, and a slip in it should not wait.
    tables = {
        name: inputs.read(modules[name].Params, params.get(name, {}), inputs.Place(name, UsageError, separator="."))
        for name in (*chosen, *params)
    }
    jobs = []
    for name in chosen:
        module, filled = modules[name], tables[name]
        first = filled.method
        if first not in module.METHODS and not user_methods.is_named(first):
            raise UsageError(f"{name}.method: expected one of {', '.join(module.METHODS)}, got {first!r}")
        used_seed = seed if seed is not None else filled.seed
        jobs += [
            Job(
                name,
                module,
                dataclasses.replace(filled, method=method, seed=used_seed),
                user_methods.load(method) if user_methods.is_named(method) else None,
            )
            for method in dict.fromkeys(offered[name] or [first])
        ]
    # Answers before comparisons, in the order of the steps.
    firsts = [next(job for job in jobs if job.step == name) for name in chosen]
    return (*firsts, *(job for job in jobs if job not in firsts))


def _in_order(chosen: Sequence[str], modules: Mapping[str, ModuleType]) -> list[str]:
    """Sort names so that a step comes after those it needs, else as they are."""
    needs = {name: [other for other in modules[name].NEEDS if other in chosen] for name in chosen}
    return list(TopologicalSorter(needs).static_order())


def execute(
    path: Path,
    scene: Scene,
    jobs: Sequence[Job],
    log: Callable[[str], None] = lambda _: None,
    piecewise: bool = False,
    so_far: Callable[[Execution], None] | None = None,
) -> Execution:
    """Run the jobs on a scene read from ``path``, ``piecewise`` on one whose points are still there.

    ``so_far`` receives what is done before each step.

    Raises InputError and UsageError as the steps do, and InputError for whatever else goes wrong within one.
    """
    from processor.adjustment.scanner_class_errors import used
    from processor.store import store
    from processor.store.streaming import points_of

    with used(scene.instruments), points_of(path) if piecewise else nullcontext() as points:
        given = {} if points is None else {"points": points}
        runs: list[StepRun] = []
        answers: dict[str, Any] = {}
        kept: dict[str, dict[str, Any]] = {}
        clouds: list[StepCloud] = []
        digest = store.scene_hash(scene, None if points is None else points.pieces)
        scene, remarks, touched = _with_points_once(scene, log)
        scene = _with_targets(scene, log)
        for job in jobs:
            if so_far is not None:
                so_far(_execution(path, scene, runs, digest, piecewise))
            needs: dict[str, Any] = {}
            if job.module.NEEDS:
                needs["earlier"] = {name: answers[name] for name in job.module.NEEDS if name in answers}
            # The step that places the scans, if the job needs it and it failed or is ambiguous
            modules = step_modules()
            placing = [name for name in job.module.NEEDS if name in answers and getattr(modules[name], "PLACES", False)]
            if stopping := next(
                (name for name in placing if answers[name].status in (Status.FAILED, Status.AMBIGUOUS)), ""
            ):
                runs.append(_stopped(job, stopping, log))
                answers.setdefault(job.step, runs[-1].result)
                continue
            if job.step in answers and getattr(job.module, "COMPARES", False):
                needs["answer_given"] = answers[job.step]
            if getattr(job.module, "KEEPS", False):
                needs["kept"] = kept.setdefault(job.step, {})
            with diagnostics.recording() as notes:
                done = _run(path, scene, job, {**given, **needs}, log)
            result = done.result
            if remarks:
                result = dataclasses.replace(result, reasons=(*result.reasons, *remarks))
            result = doubted(result) if touched else result
            runs.append(dataclasses.replace(done, result=result, diagnostics=notes.table()))
            clouds += [StepCloud(job.step, job.method, cloud) for cloud in notes.clouds]
            answers.setdefault(job.step, runs[-1].result)
        whole = _execution(path, scene, _completed(runs, answers), digest, piecewise)
        return dataclasses.replace(whole, clouds=tuple(clouds))


def _with_points_once(
    scene: Scene, log: Callable[[str], None] = lambda _: None
) -> tuple[Scene, tuple[Reason, ...], bool]:
    """Return the scene without coincident points, what was left out, and what software has done to each scan.

    The last says whether that is more than any interval holds. The scene's hash is that of what was read.
    """
    from processor import scene_cloud
    from processor.adjustment.processing.point_processing import agreed, recognised
    from processor.language.messages import messages

    scene, reasons = scene_cloud.with_points_once(scene)
    traces = agreed([recognised(scan.points) for scan in scene.scans])
    for scan, trace in zip(scene.scans, traces, strict=True):
        reasons += trace.reasons(scan.name)
    for one in reasons:
        log(messages("en").text(one))
    return scene, reasons, any(trace.unbounded for trace in traces)


def _with_targets(scene: Scene, log: Callable[[str], None] = lambda _: None) -> Scene:
    """Return the scene with the targets that it is searched for; its hash is that of what was read."""
    if scene.target_search is None or scene.targets is not None:
        return scene
    from processor.targets import find
    from processor.targets.summary import summary

    with stage("searching for targets"):
        scene = find.with_targets(scene)
    log(str(summary(scene)))
    return scene


def _execution(path: Path, scene: Scene, runs: Sequence[StepRun], digest: str, piecewise: bool) -> Execution:
    parameters = _parameters(runs)
    provenance = {
        "input": path.name,
        "input_sha256": digest,
        "seed": parameters[0]["seed"] if parameters else 0,
        "software": software(),
        "parameters": parameters,
        "epoch": epoch.facts(scene),
    }
    return Execution(scene, tuple(runs), provenance, path if piecewise else None)


def _completed(runs: Sequence[StepRun], answers: Mapping[str, Any]) -> list[StepRun]:
    """Return the runs, the answers completed by what later steps say of them."""
    modules, completed = step_modules(), []
    for run in runs:
        by_others: Callable[[Any, Mapping[str, Any]], Any] | None = getattr(modules[run.step], "completed", None)
        if by_others is not None and run.result is answers[run.step]:
            run = dataclasses.replace(run, result=by_others(run.result, answers))
        completed.append(run)
    return completed


def _stopped(job: Job, step: str, log: Callable[[str], None]) -> StepRun:
    """Return the result of a step that does not run, as the scans have no sure poses."""
    result = job.module.Result(
        status=Status.FAILED, method=job.method, reasons=(reason("pipeline.scans-not-placed", step=step),)
    )
    log(f"{job.step} ({job.method}): not run, {step} failed or is ambiguous")
    return StepRun(job.step, job.method, _json_text(job.params), result)


def _run(path: Path, scene: Scene, job: Job, given: Mapping[str, Any], log: Callable[[str], None]) -> StepRun:
    started = time.monotonic()
    try:
        with stage(f"{job.step} ({job.method})"):
            if job.function is None:
                result = job.module.run(scene, job.params, **given)
            else:
                called = user_methods.call(job.function, job.params.method, scene, job.params, given, job.module.Result)
                result = dataclasses.replace(called, method=job.method)
    except (InputError, UsageError):
        raise
    except Exception as error:
        # No input may end in a traceback: what a step did not foresee is the input's error until proved otherwise.
        raise InputError(
            f"{path.name}: internal error in step {job.step} ({job.method}): {error!r}; --debug shows where"
        ) from error
    log(f"{job.step} ({job.method}): {result.status}, {time.monotonic() - started:.1f} s")
    return StepRun(job.step, job.method, _json_text(job.params), result)


def _json_text(params: Any) -> str:
    return json.dumps(json_ready(dataclasses.asdict(params)), allow_nan=False, ensure_ascii=False)


def _parameters(runs: Sequence[StepRun]) -> list[dict[str, Any]]:
    return [{"step": run.step, **json.loads(run.params)} for run in runs]


def read_runs(results: Path) -> tuple[tuple[StepRun, ...], dict[str, Any]]:
    """Read the steps that were run earlier, and how. Raises InputError where the file does not say what it should."""
    from processor.store import store

    runs = store.read_results(results, result_classes())
    provenance = store.read_provenance(results)
    missing = {"input", "input_sha256", "seed", "software"} - set(provenance)
    if missing:
        raise InputError(f"{results}: does not say its {', '.join(sorted(missing))}; run processor run again")
    try:
        # The store sorts names, a run's parameters keep their order.
        provenance["parameters"] = _parameters(runs)
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{results}: expected the parameters of a step as JSON ({error})") from error
    return runs, provenance


def check_same_input(results: Path, provenance: Mapping[str, Any], path: Path, digest: str) -> None:
    """Raise InputError where the hash of the scene of ``path`` is not that of the input of ``results``."""
    if digest != provenance["input_sha256"]:
        raise InputError(
            f"{results}: was made from {provenance['input']!r} as it was then, not from {path} as it is "
            "(or with another --units); run processor run again"
        )


def read_execution(results: Path, path: Path, units: str | None) -> Execution:
    """Read what was run on ``path`` earlier. Raises InputError where the results are those of another input."""
    from processor.store import store
    from processor.store.streaming import points_of

    runs, provenance = read_runs(results)
    piecewise = is_large(path)
    scene = read(path, units, piecewise)
    with points_of(path) if piecewise else nullcontext() as points:
        digest = store.scene_hash(scene, None if points is None else points.pieces)
    check_same_input(results, provenance, path, digest)
    provenance["epoch"] = epoch.facts(scene)  # the title block may have changed
    return Execution(
        scene if piecewise else _with_targets(_with_points_once(scene)[0]),
        runs,
        provenance,
        path if piecewise else None,
    )


def find_input(results: Path) -> Path:
    """Return the input that results were made from: the file of its name beside their folder, or in the current one.

    Their folder may also lie in the input. Raises UsageError where there is none.
    """
    from processor.store import store

    name = str(store.read_provenance(results).get("input", ""))
    folders = (results.resolve().parent.parent, Path.cwd())
    around = [folder for folder in results.resolve().parents[1:] if folder.name == name]
    found = next((path for path in (*(folder / name for folder in folders), *around) if name and path.exists()), None)
    if found is None:
        where = " or ".join(map(str, dict.fromkeys(folders)))
        raise UsageError(f"{results}: expected its input {name!r} in {where}, found none; name INPUT")
    return found


def software() -> dict[str, str]:
    """Versions of what made a result."""
    python = ".".join(str(part) for part in sys.version_info[:3])
    found = {"processor": __version__, "python": python, **{name: version(name) for name in SOFTWARE}}
    return dict(sorted(found.items()))
