"""nfriction: identify joint friction from encoder logs, validate it by simulation, export it.

The public names are those of `__init__.pyi`; each is imported when it is first used, so that
`import nfriction` itself is quick.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
