"""DUAG-C: recordings of a robot team to one uncertainty-weighted Gaussian map, without a central server.

Everything public is a name of this package; `__init__.pyi` lists where each comes from. A name is imported when it is
used first, so that `import duagc` takes no time. The import sets what makes results independent of threads and of the
processor (`duagc.configure_determinism`); import duagc before numpy, scipy or OpenCV.
"""

import lazy_loader

from duagc.pipeline.base.determinism import configure_determinism

configure_determinism()

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
