"""Data sets of simulated rigs by name: built on first use, then read from the cache."""

from pathlib import Path
from tempfile import TemporaryDirectory

from filelock import FileLock

from nfriction.codegen.jit import cache_folder
from nfriction.papers import twin
from nfriction.papers.controller.samples import ControllerSamples, build_samples, read_samples
from nfriction.papers.twin import Twin, family
from nfriction.papers.twin.dataset import read
from nfriction.version import __version__

CONTROLLER = "tlrip_controller"
FAMILY = "twin_family"


def names() -> list[str]:
    """Names of all data sets; the cards in `datasets/` describe them."""
    return [*(f"{name}_twin" for name in twin.names()), FAMILY, CONTROLLER]


def load(
    name: str,
    *,
    truth: str = "load",
    seed: int = 0,
    duration: float | None = None,
    cache: str | Path | None = None,
) -> Twin | ControllerSamples:
    """Load a data set, building it on first use.

    Args:
        name: one of `names()`: "tlrip_twin", "rtip_twin" and "experiment_twin" (recordings of the
            papers' rigs), "twin_family" (friction and releases drawn by the seed), or
            "tlrip_controller" (40,000 samples a joint of the papers' fuzzy controllers).
        truth: of "twin_family", such as "load+warming".
        seed: of the encoders' errors; for "twin_family" of everything.
        duration: of each recording [s]; by default the data set's own.
        cache: folder that keeps what was built; by default that of compiled models
            (`NFRICTION_CACHE`).

    Returns:
        A `Twin` with `plant`, `recordings`, `splits` and `truth`, or the controller's samples.

    Raises:
        ValueError: for an unknown name or truth, or a duration that is too short.
        OSError: if the cache cannot be written.
    """
    if name not in names():
        raise ValueError(f"no data set {name!r}; there are {', '.join(names())}.")
    if name == FAMILY:
        family.effects_of(truth)  # before it names a folder
        name_in_twin, own = f"{truth}-{seed}", f"{name}-{truth}"
    else:
        name_in_twin = own = name.removesuffix("_twin")
    parent = Path(cache) if cache is not None else cache_folder() / "datasets"
    parent.mkdir(parents=True, exist_ok=True)
    # Another version may simulate another motion.
    folder = parent / f"{own}-seed{seed}-{duration or 'full'}-{__version__}"
    # The first process builds, others wait for it.
    with FileLock(f"{folder}.lock"):
        if not folder.exists():
            # Files are put in place together.
            with TemporaryDirectory(dir=parent) as aside:
                unfinished = Path(aside) / "files"
                if name == CONTROLLER:
                    build_samples(unfinished, seed=seed, duration=duration)
                elif name == FAMILY:
                    family.build(truth, unfinished, seed=seed, duration=duration or family.DURATION)
                else:
                    twin.build(own, unfinished, seed=seed, duration=duration)
                unfinished.rename(folder)
    return read_samples(folder) if name == CONTROLLER else read(name_in_twin, folder)
