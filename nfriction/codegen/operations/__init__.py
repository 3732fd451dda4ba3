"""ATen operations on arrays of scalar nodes."""

from nfriction.codegen.operations import pointwise, reductions, shaping
from nfriction.codegen.operations.registry import OPERATIONS, constants, supported_operations

__all__ = ["OPERATIONS", "constants", "pointwise", "reductions", "shaping", "supported_operations"]
