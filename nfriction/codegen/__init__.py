"""Compiled code from torch modules: rollouts for scoring, functions for controllers.

This package uses plants and friction only through the methods that it calls.
"""

from nfriction.codegen.function import CompiledFunction
from nfriction.codegen.jit import cache_folder
from nfriction.codegen.operations import supported_operations
from nfriction.codegen.rollout import CompiledRollout, RolloutInputs
from nfriction.codegen.scalar import (
    CodegenError,
    Incomparable,
    SelfCheckFailed,
    UnsupportedOperation,
)
from nfriction.codegen.staleness import content, fingerprint

__all__ = [
    "CodegenError", "CompiledFunction", "CompiledRollout", "Incomparable", "RolloutInputs",
    "SelfCheckFailed", "UnsupportedOperation", "cache_folder", "content", "fingerprint",
    "supported_operations",
]  # fmt: skip
