"""The machine's C compiler, for controllers: rollouts do without one."""

import os
import shlex
import shutil

# No errno and no traps let the compiler use its own square root and pair sin with cos; fused
# multiply-add only removes roundings. NaN keeps its meaning, unlike under -ffast-math.
FLAGS = ("-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast")


def find_compiler() -> list[str] | None:
    """The C compiler as an argument list: `CC`, else the first of cc, gcc and clang; or None."""
    named = shlex.split(os.environ.get("CC", ""))
    if named:
        return [found, *named[1:]] if (found := shutil.which(named[0])) else None
    return next(([path] for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)
