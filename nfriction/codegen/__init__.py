"""Compiled code from torch modules: rollouts for scoring, functions for controllers.

Knows nothing of plants or friction beyond the methods it calls.
"""

from nfriction.codegen.errors import (
    CodegenError,
    NoBackend,
    SelfCheckFailed,
    UnsupportedOperation,
)
from nfriction.codegen.function import CompiledFunction, compile_function
from nfriction.codegen.llvm.jit import cache_folder
from nfriction.codegen.operations import supported_operations
from nfriction.codegen.rollout import CompiledRollout, RolloutSignals, Trajectories, compile_rollout

__all__ = [
    "CodegenError",
    "CompiledFunction",
    "CompiledRollout",
    "NoBackend",
    "RolloutSignals",
    "SelfCheckFailed",
    "Trajectories",
    "UnsupportedOperation",
    "cache_folder",
    "compile_function",
    "compile_rollout",
    "supported_operations",
]
