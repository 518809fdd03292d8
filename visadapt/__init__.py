"""Adapts control policies from pixels to a machine whose dynamics differ from the simulator's.

Every name that a user needs is a name of this package; `__init__.pyi` lists them, and each is imported when it
is first asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
