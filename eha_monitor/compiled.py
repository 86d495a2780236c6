"""Compiled functions: numba with a cache on disk that cannot go stale.

numba's own cache looks only at the file of the outermost function; a change in an inlined
callee is missed.  Here the cache folder carries a hash of every source file of the package,
so changed physics is always compiled anew, and a read-only installation works too.  Where it
lies, and why every copy of the package shares it: :mod:`eha_monitor.compiled_cache`.
"""

import hashlib
import re
import warnings
from pathlib import Path

import numba
from numba.core import types
from numba.core.registry import CPUDispatcher, cpu_target

from eha_monitor import compiled_cache

_IMPORTS = re.compile(rb"^\s*from eha_monitor\.([\w.]+) import (\([^)]*\)|.*)$", re.MULTILINE)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]*\b")


def _source_hash() -> str:
    root = Path(__file__).parent
    digest = hashlib.sha256()
    digest.update(Path(__file__).read_bytes())  # the options are here
    sources = {path: path.read_bytes()
               for folder in ("physics", "estimation", "recordings", "mismatch", "concealed")
               for path in (root / folder).rglob("*.py")}
    # What is compiled, physics with its constants, and where these have constants from: a constant
    # is part of the compiled code, a function that is not compiled is not.
    wanted = [path for path, source in sources.items()
              if b"njit" in source or path.is_relative_to(root / "physics")]
    taken: set[Path] = set()
    while wanted:
        path = wanted.pop()
        if path in taken or path not in sources:
            continue
        taken.add(path)
        for module, names in _IMPORTS.findall(sources[path]):
            place = root / module.decode().replace(".", "/")
            wanted += [place.with_suffix(".py")] if _CONSTANT.search(names) else []
            wanted += [place / f"{name.decode()}.py" for name in re.findall(rb"\w+", names)]
    for path in sorted(taken):
        digest.update(str(path.relative_to(root)).encode() + sources[path])
    return digest.hexdigest()[:16]


PLACES = compiled_cache.places(_source_hash())
CACHE = PLACES[0]
FIRST_RUN = not any(place.exists() for place in PLACES)
ANNOUNCER = compiled_cache.announce(CACHE)

# The catalogue calls its terms through a tuple of functions: works, cached, "experimental".
warnings.filterwarnings("ignore", category=numba.core.errors.NumbaExperimentalFeatureWarning)
literal_unroll = numba.literal_unroll


def njit(function=None, *, cache: bool = True, allocates: bool = True, **options):
    """``numba.njit`` with the cache on, usable with and without arguments.

    A function that neither makes nor returns an array may say so: ``allocates=False``.  It then
    counts no references to the arrays it is given (its caller holds them), nor to views of them.
    Each count is an atomic instruction: in a step of a small filter they took two thirds of the
    time.  A function that says so and makes an array, or returns one, is refused.
    """
    options.setdefault("error_model", "numpy")
    # Fused multiply-add and reciprocals; NaN keeps its meaning (it marks what is missing).
    options.setdefault("fastmath", {"contract", "arcp"})
    if function is None:
        return lambda inner: njit(inner, cache=cache, allocates=allocates, **options)
    # Always given: else a function takes it from whichever caller has it compiled first.
    made = numba.njit(function, _nrt=allocates, **options)
    if isinstance(made, CPUDispatcher):  # NUMBA_DISABLE_JIT: the function itself
        made.get_call_template = _whatever_the_value(made.get_call_template)
        if not allocates:
            made.add_overload = _without_an_array(made.add_overload)
    # A function of somebody else's file is kept by nobody: the folder is named by our source.
    ours = Path(function.__code__.co_filename).is_relative_to(compiled_cache.PACKAGE)
    if cache and ours and isinstance(made, CPUDispatcher):
        made._cache = compiled_cache.SharedCache(function, PLACES)
    return made


def _whatever_the_value(template):
    """Let a call with a constant, as in ``f(x, True)``, take the code of any value.

    numba compiles a function anew for each constant that a caller passes.  What is written into
    its caller knows the constant all the same.
    """
    def plain(args, kws):
        return template(tuple(types.unliteral(given) for given in args),
                        {name: types.unliteral(given) for name, given in kws.items()})
    return plain


def _without_an_array(add):
    """Refuse an array that a function returns uncounted: its caller would free it once more."""
    def checked(compiled):
        returned = cpu_target.target_context.data_model_manager[compiled.signature.return_type]
        if returned.contains_nrt_meminfo():
            raise TypeError(f"{compiled.fndesc.qualname} returns an array: it may not say "
                            "allocates=False")
        add(compiled)
    return checked


def load_runtime() -> None:
    """Start what compiled functions run on, so that it counts as start and not as an answer."""
    from numba.core.runtime import rtsys

    rtsys.initialize(cpu_target.target_context)
