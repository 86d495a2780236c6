"""Condition monitor for electrohydraulic actuators (ROS 2 Jazzy)."""

import os

# The matrices here are small and the filters run one to a core: more BLAS threads only spin
# (17.5 against 10.4 s of processor time for a diagnosis).  Numpy reads this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# LLVM's third level takes a quarter more of the time that `make setup` compiles, and the filters
# run no faster for it.  Numba reads this when it is imported.
os.environ.setdefault("NUMBA_OPT", "2")

__version__ = "0.1.0"
