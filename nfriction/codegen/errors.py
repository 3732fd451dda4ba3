"""Errors between a torch module and its compiled form, named for what happened."""


class CodegenError(RuntimeError):
    """Base of everything the code generator raises on purpose."""


class UnsupportedOperation(CodegenError):  # noqa: N818
    """A traced module uses an operation that has no scalar form here.

    The torch rollout runs every module; only the compiled one needs this list.
    """

    def __init__(self, operation: str, reason: str = "has no scalar form here") -> None:
        super().__init__(
            f"operation `{operation}` {reason}; rewrite it with the operations listed in "
            "`nfriction.codegen.supported_operations()`, or use the torch rollout "
            '(`backend="torch"`), which runs every module.'
        )
        self.operation = operation


class SelfCheckFailed(CodegenError):  # noqa: N818
    """A compiled model disagrees with eager torch and must not be used."""


class Incomparable(CodegenError):  # noqa: N818
    """Something that a trace may read cannot be compared with what it was before."""
