"""All active effects of the catalogue in one compiled call."""

import math
from collections.abc import Callable

import numpy as np

from eha_monitor.compiled import njit
from eha_monitor.physics.effect import no_circuit, no_term, no_update
from eha_monitor.physics.effects import CATALOGUE, NAMES
from eha_monitor.physics.own_term import (
    OWN_NAMES,
    SINCE,
    SLOTS,
    TURNED,
    WIDTH,
    own_term,
    turn,
    turns,
)
from eha_monitor.physics.signals import LIMITS, MAX_MEMORY, MAX_PARAMETERS, N_BASE, N_CIRCUIT

ALL_NAMES = (*NAMES, *OWN_NAMES)  # in the order of their places
N_EFFECTS = len(ALL_NAMES)
FIRST_OWN = N_BASE + len(NAMES) * MAX_PARAMETERS  # place in theta of the rig's own terms
N_THETA = FIRST_OWN + SLOTS * WIDTH
_EFFECTS = tuple(CATALOGUE.values())
_OWN = (False,) * SLOTS
_HAS_TERM = np.array([*(effect.term is not no_term for effect in _EFFECTS), *(True,) * SLOTS])
_HAS_UPDATE = np.array([*(effect.update is not no_update for effect in _EFFECTS), *_OWN])
_HAS_PLACE = np.array([*(effect.remembers_place for effect in _EFFECTS), *_OWN])
_HAS_CIRCUIT = np.array([*(effect.circuit is not no_circuit for effect in _EFFECTS), *_OWN])


def slot_of(which: int) -> slice:
    """Return the places in theta of an effect, or of one of the rig's own terms."""
    if which < len(NAMES):
        start = N_BASE + which * MAX_PARAMETERS
        return slice(start, start + MAX_PARAMETERS)
    start = FIRST_OWN + (which - len(NAMES)) * WIDTH
    return slice(start, start + WIDTH)


# Place in theta of the displacement over which a friction turns over; 0 there needs no memory.
_TURNS_OVER = np.array([*(next((slot_of(which).start + i for i, p in enumerate(effect.parameters)
                                if effect.remembers_place and p.name == "z_0"), -1)
                          for which, effect in enumerate(_EFFECTS)), *(-1,) * SLOTS])


def _valve(opens: str) -> tuple[int, int, int]:
    """Return a valve's place among the effects, and those of its k and pressure in theta."""
    which = next(which for which, effect in enumerate(_EFFECTS) if effect.valve == opens)
    start = slot_of(which).start
    return which, start, start + 1


CHECK_VALVE, CHECK_VALVE_K, CHECK_VALVE_P = _valve("below")
RELIEF_VALVE, RELIEF_VALVE_K, RELIEF_VALVE_P = _valve("beyond")


def _parameters(which: int) -> str:
    """Return the parameters of an effect or own term out of theta, as source."""
    own = slot_of(which)
    if which >= len(NAMES) or not _EFFECTS[which].rig_numbers:
        return f"theta[{own.start}:{own.stop}]"
    last = own.start + len(_EFFECTS[which].parameters)
    places = (*range(own.start, last), *_EFFECTS[which].rig_numbers)
    return f"({', '.join(f'theta[{place}]' for place in places)},)"


def _by_place(functions: list[Callable], wanted: np.ndarray, call: str, header: str) -> Callable:
    """Return a compiled function that calls one entry's function by its place ``which``.

    Written out as a chain of comparisons, which the compiler turns into one jump; numba's own
    loop over a tuple of functions costs several times the physics.

    Parameters
    ----------
    call : arguments of the entry's function, with ``{p}`` for its parameters and ``{m}`` for its
        memory.
    header : arguments of the function made.
    """
    lines = [f"def by_place({header}):", "    if which < 0:", "        pass"]
    for i in np.flatnonzero(wanted):
        given = call.format(p=_parameters(int(i)), m=f"memory[{i}]")
        lines += [f"    elif which == {i}:", f"        function_{i}({given})"]
    names = {f"function_{i}": function for i, function in enumerate(functions)}
    exec(compile("\n".join(lines), "<catalogue>", "exec"), names)
    return njit(names["by_place"], cache=False, forceinline=True, allocates=False)


_term = _by_place([*(e.term for e in _EFFECTS), *(own_term,) * SLOTS], _HAS_TERM, "s, {p}, {m}, c",
                  "which, s, theta, memory, c")
_update = _by_place([*(e.update for e in _EFFECTS), *(turn,) * SLOTS],
                    np.array([*_HAS_UPDATE[:-SLOTS], *(True,) * SLOTS]), "s, {p}, h, {m}",
                    "which, s, theta, h, memory")
_circuit = _by_place([e.circuit for e in _EFFECTS], _HAS_CIRCUIT, "{p}, w", "which, theta, w")


def new_memory() -> np.ndarray:
    """Return the memory of all effects at the start, (N_EFFECTS, MAX_MEMORY)."""
    return np.zeros((N_EFFECTS, MAX_MEMORY))


def turned_memory(angle: float, time: float = 0.0) -> np.ndarray:
    """Return the memory of what begins at an angle of the shaft, rad, and at a time, s."""
    memory = new_memory()
    memory[len(NAMES) :, TURNED], memory[len(NAMES) :, SINCE] = angle, time
    return memory


@njit
def _both(active, have):
    """Return the places at which both are true, ascending.  numba's own compile for seconds."""
    places, count = np.empty(N_EFFECTS, dtype=np.int64), 0
    for which in range(N_EFFECTS):
        if active[which] and have[which]:
            places[count] = which
            count += 1
    return places[:count]


@njit
def with_term(active):
    """Return the places of the active effects that have a term, ascending."""
    return _both(active, _HAS_TERM)


@njit
def with_update(active, theta):
    """Return the places of the active effects that remember, ascending."""
    have = _HAS_UPDATE.copy()
    for which in range(N_EFFECTS):
        if _TURNS_OVER[which] >= 0 and theta[_TURNS_OVER[which]] <= 0.0:
            have[which] = False
    for i in range(SLOTS):
        have[N_EFFECTS - SLOTS + i] = turns(theta[FIRST_OWN + i * WIDTH : FIRST_OWN
                                                  + (i + 1) * WIDTH])
    return _both(active, have)


@njit
def with_place(active):
    """Return the places of the active effects whose memory holds a position, ascending."""
    return _both(active, _HAS_PLACE)


@njit(forceinline=True, allocates=False)
def shift_memory(places, by, memory):
    """Move remembered positions by ``by`` m: a filter has corrected the position, nothing slid."""
    for which in places:
        memory[which, 1] += by


@njit(forceinline=True, allocates=False)
def add_contributions(s, theta, terms, memory, c):
    """Fill ``c`` with the sum of the active effects.

    Parameters
    ----------
    s : (N_SIGNALS,) signals, SI.
    theta : (N_THETA,) base parameters, then MAX_PARAMETERS places for each effect, then WIDTH
        for each own term of the rig.
    terms : places of the effects that add (:func:`with_term`).
    memory : (N_EFFECTS, MAX_MEMORY), read.
    c : (N_CONTRIBUTIONS,) written.
    """
    c[:] = 0.0
    for which in terms:
        _term(which, s, theta, memory, c)


@njit(forceinline=True, allocates=False)
def update_memory(s, theta, updates, h, memory):
    """Carry the memory of effects (:func:`with_update`) over a step of ``h`` s ending at ``s``.

    The shaft's speed among the signals is its mean over the step: where the command is held, it
    jumps at the step's ends, and half of either would be as late as half a step.
    """
    for which in updates:
        _update(which, s, theta, h, memory)


@njit(forceinline=True, allocates=False)
def valves_of(theta, terms):
    """Return where valves begin to open, and how fast they pass.

    Returns
    -------
    below : Pa, a chamber's pressure under which one feeds it; -inf where none does.
    beyond : Pa, difference of the pressures over which one relieves it; inf where none does.
    conductance : of all that may be open, m^3/(s Pa): a chamber of volume V settles with
        beta_e times this over V.  What moves from one chamber to the other counts twice.
    """
    below, beyond, conductance = -math.inf, math.inf, 0.0
    for which in terms:
        if which == CHECK_VALVE:
            conductance += theta[CHECK_VALVE_K]
            below = theta[CHECK_VALVE_P]
        elif which == RELIEF_VALVE:
            conductance += 2.0 * theta[RELIEF_VALVE_K]
            beyond = theta[RELIEF_VALVE_P]
    return below, beyond, conductance


@njit
def circuit_of(theta, active):
    """Return the constants of drive and sensors, (N_CIRCUIT,), with the active effects."""
    w = np.zeros(N_CIRCUIT)
    for place in LIMITS:
        w[place] = np.inf
    for which in range(N_EFFECTS):
        if active[which] and _HAS_CIRCUIT[which]:
            _circuit(which, theta, w)
    return w
