"""Condition monitor for electrohydraulic actuators (ROS 2 Jazzy).

In Python and in notebooks, with the answers of the commands as typed records:

    import eha_monitor as em

    recording = em.read("bags/hidden_friction")
    diagnosis = em.diagnose(recording)
    diagnosis.effects, diagnosis.plot()

The reference is docs/api.md.
"""

import os

# The matrices here are small and the filters run one to a core: more BLAS threads only spin
# (17.5 against 10.4 s of processor time for a diagnosis).  Numpy reads this when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# LLVM's third level takes a quarter more of the time that `make setup` compiles, and the filters
# run no faster for it.  Numba reads this when it is imported.
os.environ.setdefault("NUMBA_OPT", "2")

__version__ = "0.1.0"

TYPE_CHECKING = False  # as typing's, whose import takes three times as long as all of this
if TYPE_CHECKING:
    from eha_monitor.api.advise import Advice, advise
    from eha_monitor.api.config import Config
    from eha_monitor.api.diagnose import Diagnosis, diagnose
    from eha_monitor.api.estimate import Estimate, estimate
    from eha_monitor.api.read import ImplausibleError, read
    from eha_monitor.api.recording import Recording
    from eha_monitor.api.simulate import simulate
    from eha_monitor.errors import InputError

# Name -> module that has it.  They are imported when they are first used: what the commands and
# the nodes import of this package must stay quick.
_PLACES = {
    "Advice": "api.advise", "Config": "api.config", "Diagnosis": "api.diagnose",
    "Estimate": "api.estimate", "ImplausibleError": "api.read", "InputError": "errors",
    "Recording": "api.recording", "advise": "api.advise", "diagnose": "api.diagnose",
    "estimate": "api.estimate", "read": "api.read", "simulate": "api.simulate"}

__all__ = [  # noqa: RUF022  in the order of the reference
    "read", "simulate", "estimate", "diagnose", "advise", "Config", "Recording", "Estimate",
    "Diagnosis", "Advice", "InputError", "ImplausibleError"]


def __getattr__(name: str):
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    found = getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
