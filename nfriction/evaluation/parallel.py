"""Fit many models in parallel in joblib's processes, in an order that lets most run at once.

The processes are joblib's own on this machine, or those of a cluster if the caller chooses one with
`with joblib.parallel_config(backend="dask"):`. Logs and warnings of a task are returned with its
result and reported here. Every task has one thread wherever it runs, so that the results do not
depend on the number of processes.
"""

import logging
import logging.handlers
import signal
import textwrap
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from numbers import Integral
from queue import SimpleQueue
from typing import Any, NamedTuple, TypeVar

import torch

from nfriction.fitting.data.inputs import in_joint_coordinates, turning_velocity
from nfriction.fitting.fit import fit
from nfriction.fitting.result.fit_result import FitResult
from nfriction.friction import model_by_name, model_name
from nfriction.friction.models import ConstantModel, FrictionModel
from nfriction.plant import Plant
from nfriction.recording import Recording
from nfriction.signals import Motion

logger = logging.getLogger(__name__)

T = TypeVar("T")
# Identifies this process; a task that finds another value runs elsewhere.
_HERE = uuid.uuid4().hex
INTERRUPTED = "interrupted"
_PACKAGE = logging.getLogger("nfriction")


class Progress:
    """Receiver of progress reports; this one ignores them."""

    def expect(self, stages: int) -> None:
        """Announce further stages."""

    def stage(self, what: str) -> None:
        """Begin a stage; several may run at the same time."""

    def done(self) -> None:
        """End a stage."""

    def step(self, stage: str) -> None:
        """Count a step of a search that runs in this process."""

    def resume(self) -> None:
        """Go on after a Ctrl-C, with the fits that were finished by then."""


class Data(NamedTuple):
    """Recordings, and their smoothed motions in joint coordinates."""

    recordings: Sequence[Recording]
    motions: Sequence[Motion]


class Fits(NamedTuple):
    """Fits by model, in the requested order, and the reason if a model has none."""

    found: dict[str, FitResult]
    failed: dict[str, str]


class FitsInterrupted(KeyboardInterrupt):
    """A Ctrl-C while models are fitted; `fits` are those finished by then, by part."""

    def __init__(self, fits: dict[str, Fits]) -> None:
        super().__init__()
        self.fits = fits


def fit_models(
    plant: Plant,
    models: Sequence[str],
    parts: Mapping[str, Data],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    **fit_settings: Any,
) -> dict[str, Fits]:
    """Fit every model to every part of the data, in levels of independent fits.

    Arguments and errors are those of `compare`; `parts` are data by the label of the work on them,
    such as "fit". A model that cannot be fitted does not stop the others; a Ctrl-C raises
    FitsInterrupted. Returns fits by part.
    """
    check_jobs(jobs)
    if jobs != 1 and fit_settings.get("callback") is not None:
        raise ValueError("`callback` cannot be called from other processes; with `jobs` above 1 "
                         "use `progress`.")  # fmt: skip
    progress = progress or Progress()
    if jobs == 1:
        step = progress.step
        fit_settings = {"callback": lambda stage, _: step(stage)} | fit_settings
    names = list(dict.fromkeys(map(model_name, models)))
    results = {part: Fits({}, {}) for part in parts}
    errors: list[Exception] = []
    origin = warm_starts(names)
    progress.expect(len(parts) * len(names))
    turning = {}
    for part, (given, moved) in parts.items():
        joint = in_joint_coordinates(plant, given, plant.joints)
        turning[part], _ = turning_velocity(plant, joint, moved)
    try:
        for level in dependency_levels(origin):
            labels = {f"{part} {name}": (part, name) for part in parts for name in level}
            tasks = {
                # An instance, because another process may not know a user's law.
                label: (
                    model_by_name(name)(plant.joints, v_smooth=turning[part]), plant, parts[part],
                    results[part].found.get(origin[name] or ""), fit_settings,
                )
                for label, (part, name) in labels.items()
            }  # fmt: skip
            for label, (result, seconds) in as_completed(_fit, tasks, jobs=jobs, progress=progress):
                part, name = labels[label]
                if isinstance(result, Exception):
                    errors.append(result)
                    results[part].failed[name] = str(result)
                    logger.warning("%s failed: %s", label, result)
                    continue
                # A result from another process has copies of the motions.
                found = replace(result, motions=tuple(parts[part].motions))
                results[part].found[name] = found
                logger.info("%s: %s (%.3g s)", label, result.status, seconds)
    except KeyboardInterrupt as interrupt:
        for of in results.values():
            for name in set(names).difference(of.found):
                of.failed.setdefault(name, INTERRUPTED)
        raise FitsInterrupted(_in_order(results, names)) from interrupt
    if not any(of.found for of in results.values()):
        raise errors[0]
    return _in_order(results, names)


def _in_order(results: dict[str, Fits], names: Sequence[str]) -> dict[str, Fits]:
    """Fits in the requested order of models, instead of that in which they were finished."""
    return {
        part: Fits(
            {name: found[name] for name in names if name in found},
            {name: failed[name] for name in names if name in failed},
        )
        for part, (found, failed) in results.items()
    }


def warm_starts(models: Sequence[str]) -> dict[str, str | None]:
    """The model from whose fit each model starts, None for none.

    Constant laws start with the plant terms of the first of them; all other models with the
    constant fit of their own law, or of the first if that is not requested.
    """
    kinds = {name: model_by_name(name) for name in models}
    constant = {n: k.definition for n, k in kinds.items() if issubclass(k, ConstantModel)}
    first = next(iter(constant), None)
    origin: dict[str, str | None] = {}
    for name, kind in kinds.items():
        own = next((n for n, law in constant.items() if law == kind.definition), first)
        origin[name] = None if name == first else first if own == name else own
    return origin


def dependency_levels(origin: Mapping[str, str | None]) -> Iterator[list[str]]:
    """Names in groups: each starts from a fit of an earlier group, or from none."""
    fitted: set[str | None] = {None}
    while len(fitted) <= len(origin):
        ready = [n for n, start in origin.items() if start in fitted and n not in fitted]
        yield ready
        fitted |= set(ready)


def _fit(
    model: FrictionModel,
    plant: Plant,
    data: Data,
    start: FitResult | None,
    settings: dict[str, Any],
) -> tuple[FitResult | Exception, float]:
    """A fit or its error, and the time it took [s]."""
    begun = time.perf_counter()
    result: FitResult | Exception
    try:
        result = fit(model, plant, data.recordings, motions=data.motions, start=start, **settings)
    except (ValueError, ArithmeticError, RuntimeError) as error:
        result = error
    return result, time.perf_counter() - begun


def check_jobs(jobs: int) -> None:
    """Require at least one process, and joblib where there are several."""
    if not isinstance(jobs, Integral) or jobs == 0:
        raise ValueError(f"`jobs` must be at least 1, or -1 for one per core, got {jobs!r}.")
    if jobs != 1:
        try:
            import joblib  # noqa: F401
        except ImportError as error:
            raise ImportError(
                f"jobs={jobs} needs joblib: `pip install nfriction[parallel]`; jobs=1 does not."
            ) from error


def as_completed(
    work: Callable[..., T],
    tasks: Mapping[str, tuple[Any, ...]],
    *,
    jobs: int = 1,
    progress: Progress | None = None,
) -> Iterator[tuple[str, T]]:
    """Run independent tasks and yield label and result of each when it is finished.

    The first error of a task is raised, its message preceded by the label; tasks not finished by
    then are abandoned.

    Args:
        work: a function; for more than one process it must be importable by its name.
        tasks: its arguments by the label of each task.
        jobs: number of processes; with 1, or a single task, the tasks run in this process.
        progress: receives the labels.
    """
    progress = progress or Progress()
    level = _PACKAGE.getEffectiveLevel()
    calls = [(label, work, arguments, _HERE, level) for label, arguments in tasks.items()]
    if jobs == 1 or len(calls) < 2:
        for call in calls:
            progress.stage(call[0])
            label, value, _ = _run(*call)
            progress.done()
            yield label, value
        return
    from joblib import Parallel, delayed

    progress.stage(textwrap.shorten(" | ".join(tasks), 60, placeholder=" ..."))
    shown: dict[Any, int] = {}
    pool = Parallel(n_jobs=min(jobs, len(calls)), batch_size=1, return_as="generator_unordered")
    with _ignore_sigint():
        results = pool(delayed(_run)(*call) for call in calls)
    for finished, (label, value, log) in enumerate(results, 1):
        log.replay(shown)
        progress.done()
        progress.stage(f"{label} done, {len(calls) - finished} of {len(calls)} left")
        yield label, value


@dataclass
class TaskLog:
    """Log records and warnings of a task."""

    records: list[logging.LogRecord] = field(default_factory=list)
    warned: list[warnings.WarningMessage] = field(default_factory=list)

    def replay(self, shown: dict[Any, int]) -> None:
        """Report them in this process; `shown` is the registry of warnings already shown."""
        for record in self.records:
            logger = logging.getLogger(record.name)
            if logger.isEnabledFor(record.levelno):
                logger.handle(record)
        for w in self.warned:
            warnings.warn_explicit(str(w.message), w.category, w.filename, w.lineno, registry=shown)


def _run(
    label: str, work: Callable[..., T], arguments: tuple[Any, ...], home: str, level: int
) -> tuple[str, T, TaskLog]:
    """Run a task on one thread; `home` is the calling process, `level` that of its logs."""
    log = TaskLog()
    with one_thread(), nullcontext() if home == _HERE else _capture_logs(log, level):
        try:
            return label, work(*arguments), log
        except (ValueError, TypeError, LookupError, ArithmeticError, RuntimeError) as error:
            error.args = (f"{label}: {error}", *error.args[1:])
            raise


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: faster for small tensors, and the same sums on every machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _capture_logs(log: TaskLog, level: int) -> Iterator[None]:
    """Collect the log records of this thread and the warnings of the block."""
    queue: SimpleQueue[logging.LogRecord] = SimpleQueue()
    # This handler converts records to a form that can be sent to another process.
    handler = logging.handlers.QueueHandler(queue)
    thread = threading.get_ident()
    handler.addFilter(lambda record: record.thread == thread)
    before = _PACKAGE.level
    _PACKAGE.addHandler(handler)
    _PACKAGE.setLevel(level)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
    finally:
        _PACKAGE.removeHandler(handler)
        _PACKAGE.setLevel(before)
    log.warned += caught
    log.records += [queue.get() for _ in range(queue.qsize())]


@contextmanager
def _ignore_sigint() -> Iterator[None]:
    """Child processes started here ignore Ctrl-C, which a terminal sends to all of them.

    The parent terminates them; their solvers would take it as a request to stop early.
    """
    before = signal.getsignal(signal.SIGINT)
    if before is None or threading.current_thread() is not threading.main_thread():
        yield  # set outside Python, or not for this thread to change
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
