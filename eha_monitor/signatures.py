"""What commands call of what is compiled, with the types: generated, the longest first.

``python benchmarks/compilations.py --write`` makes it; :mod:`eha_monitor.compile_all` reads it.
"""

import importlib

from numba.core.types import Array, BaseTuple, UniTuple, bool, float64, int64, uint8


def named(module: str, name: str, *fields) -> BaseTuple:
    """Return the type of a named tuple of the package."""
    return BaseTuple.from_types(fields, getattr(importlib.import_module(module), name))


# What a simulator, a monitor and a replay call: `make demo` begins once these are compiled.
LIVE = (
    ("estimation.drive", "follow"),
    ("estimation.hold_choice", "log_likelihood"),
    ("estimation.modelled", "contributions"),
    ("estimation.stage_one", "run_one"),
    ("estimation.stage_two", "log_likelihood_two"),
    ("estimation.stage_two", "run_two"),
    ("physics.contributions", "circuit_of"),
    ("physics.plant", "run"),
    ("recordings.walk", "walk_records"),
)
# The named tuples of the package that they take.
Model = named(
    'eha_monitor.mismatch.likelihood.tangent_motion', 'Model', int64, float64, int64, float64[::1],
    float64[::1], bool, float64, float64, int64[::1], int64[::1], int64[::1])
Motion = named(
    'eha_monitor.mismatch.likelihood.tangent_motion', 'Motion', float64[:, ::1], float64[::1],
    float64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1])
Points = named(
    'eha_monitor.mismatch.likelihood.tangent_motion', 'Points', int64[::1], float64[::1],
    float64[:, ::1], float64[:, ::1], float64[::1], float64[:, ::1], float64[:, ::1],
    float64[:, ::1], int64[::1], float64[:, :, :, ::1], float64[:, :, :, :, ::1],
    float64[:, :, ::1], float64[:, :, :, :, ::1])
Linear = named(
    'eha_monitor.mismatch.likelihood.tangent_pass', 'Linear', float64[:, ::1], float64[:, :, ::1],
    float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1],
    float64[::1])
Lanes = named(
    'eha_monitor.mismatch.likelihood.tangent_lanes', 'Lanes', int64[::1], int64[::1],
    float64[:, ::1], float64[:, ::1], bool[::1], bool[::1], float64[::1], float64[::1],
    float64[:, :, ::1], float64[:, :, ::1], float64[:, ::1])
Corrections = named(
    'eha_monitor.mismatch.likelihood.tangent_lanes', 'Corrections', float64[:, :, ::1],
    float64[:, ::1], float64[::1], float64)
RowsTwo = named(
    'eha_monitor.estimation.stage_two', 'RowsTwo', float64[::1], float64[::1], float64[::1],
    float64[::1], float64[:, ::1], float64[::1], float64[::1], float64[::1], float64[::1])
ConstantsTwo = named(
    'eha_monitor.estimation.stage_two', 'ConstantsTwo', float64[::1], float64, float64, float64,
    float64, float64)
Effects = named(
    'eha_monitor.estimation.modelled', 'Effects', float64[::1], int64[::1], int64[::1], int64[::1])
Actuator = named(
    'eha_monitor.physics.plant', 'Actuator', float64[::1], float64[:, ::1], float64[:, ::1],
    int64[::1])
Given = named('eha_monitor.physics.plant', 'Given', float64[:, ::1], int64, int64, bool)
Step = named('eha_monitor.physics.plant', 'Step', float64, int64)
RowsOne = named(
    'eha_monitor.estimation.stage_one', 'RowsOne', float64[::1], float64[::1], float64[::1],
    float64[::1], float64[::1], float64[::1])
ConstantsOne = named(
    'eha_monitor.estimation.stage_one', 'ConstantsOne', float64, float64, float64, float64, bool)
StateOne = named(
    'eha_monitor.estimation.stage_one', 'StateOne', float64[::1], float64[::1], float64[::1],
    float64[:, ::1])
Stretch = named(
    'eha_monitor.estimation.hold_choice', 'Stretch', float64[:, ::1], float64[::1], float64[::1],
    bool[::1], float64[::1], float64, float64, float64, UniTuple(float64, 2), float64, float64)
RowsJoint = named(
    'eha_monitor.estimation.joint', 'RowsJoint', float64[::1], float64[::1], float64[::1],
    float64[::1], float64[::1], float64[:, ::1])
ConstantsJoint = named(
    'eha_monitor.estimation.joint', 'ConstantsJoint', float64[::1], float64, float64, float64,
    bool)
StateJoint = named(
    'eha_monitor.estimation.joint', 'StateJoint', float64[::1], float64[:, ::1],
    float64[:, :, ::1], float64[::1])
StateTwo = named(
    'eha_monitor.estimation.stage_two', 'StateTwo', float64[::1], float64[:, ::1], float64[::1],
    float64[::1], float64[:, ::1], float64[:, ::1], float64[::1])
Record = named(
    'eha_monitor.mismatch.likelihood.innovations', 'Record', int64, float64[:, ::1],
    float64[:, ::1], UniTuple(float64[::1], 2), float64[::1])
Correction = named(
    'eha_monitor.mismatch.likelihood.innovations', 'Correction', float64[:, :, ::1], float64)
Course = named(
    'eha_monitor.estimation.drive', 'Course', int64, float64[::1], float64[::1], float64[::1],
    float64, bool)
Printed = named(
    'eha_monitor.estimation.reference_stages', 'Printed', float64, float64, float64, float64,
    float64)
Regained = named(
    'eha_monitor.mismatch.name.gram', 'Regained', float64[:, ::1], float64[:, ::1],
    float64[:, :, ::1], float64[:, :, ::1], float64[:, ::1])
Messages = named(
    'eha_monitor.recordings.walk', 'Messages', int64[::1], int64[::1], int64[::1], int64[::1])
Others = named('eha_monitor.recordings.walk', 'Others', int64[::1], int64[::1], int64[::1])
SIGNATURES = (
    ("mismatch.likelihood.tangent_pass", "carried_on", (
        Model, Motion, Points, Linear, Lanes, Corrections, int64[::1], float64[:, :, ::1])),
    ("estimation.stage_two", "log_likelihood_two", (RowsTwo, ConstantsTwo, Effects, float64)),
    ("physics.plant", "run", (
        Actuator, float64, Given, Step, float64[:, ::1], bool[::1], float64[:, ::1],
        float64[:, ::1])),
    ("estimation.stage_one", "run_one", (
        RowsOne, ConstantsOne, Effects, StateOne, int64, float64[:, ::1], float64[:, ::1])),
    ("mismatch.likelihood.tangent_motion", "look", (
        Model, Motion, Points, float64[::1], float64[:, ::1])),
    ("mismatch.likelihood.innovations", "transition", (
        int64, Step, float64[::1], bool[::1], float64, float64[::1], float64[:, ::1],
        float64[::1])),
    ("estimation.hold_choice", "log_likelihood", (
        Stretch, float64[::1], float64[::1], float64, float64, float64, float64)),
    ("concealed.plant", "run", (float64[::1], float64[::1], float64, float64[:, ::1])),
    ("estimation.joint", "filter_joint", (
        RowsJoint, ConstantsJoint, StateJoint, int64, float64[:, ::1])),
    ("mismatch.likelihood.tangent_motion", "slopes_along", (Model, Motion, float64[:, ::1])),
    ("estimation.stage_two", "run_two", (
        RowsTwo, ConstantsTwo, Effects, StateTwo, int64, float64[:, ::1], float64[:, ::1])),
    ("physics.contributions", "circuit_of", (float64[::1], bool[::1])),
    ("mismatch.likelihood.innovations", "innovate", (
        Record, Step, float64[::1], bool[::1], Correction, Actuator, float64[:, ::1],
        float64[:, ::1])),
    ("mismatch.likelihood.tangent_motion", "jacobians", (
        Model, Motion, float64[::1], float64[:, ::1], float64[:, :, ::1])),
    ("estimation.drive", "follow", (
        Course, float64, float64[::1], int64[::1], float64[::1], float64[:, ::1])),
    ("mismatch.likelihood.innovations", "riccati", (
        float64[:, ::1], float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], bool[::1],
        float64[:, :, ::1])),
    ("estimation.reference_stages", "_run", (
        UniTuple(float64[::1], 3), Printed, float64, float64, float64[::1], float64[:, ::1],
        float64[:, ::1])),
    ("mismatch.name.gram", "mapped", (
        float64[:, :, ::1], bool[:, ::1], Regained, int64, float64[:, ::1], float64[:, :, ::1])),
    ("mismatch.locate.location", "rival_innovations", (
        float64[:, ::1], int64[::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1],
        float64[:, :, ::1], float64[:, ::1])),
    ("estimation.modelled", "contributions_along", (
        float64[:, ::1], float64, int64, float64[::1], bool[::1], float64[:, ::1],
        float64[:, ::1])),
    ("recordings.walk", "walk_records", (
        Array(uint8, 1, 'C', readonly=True, aligned=True), int64, Messages, Others)),
    ("mismatch.name.gram", "powers_at", (
        float64[:, ::1], bool[:, ::1], bool[::1], float64[:, ::1], float64[:, ::1],
        float64[:, :, ::1], float64[:, :, :, ::1], float64[:, :, ::1])),
    ("mismatch.likelihood.along", "drive_along", (
        float64[::1], float64[:, ::1], float64, int64, float64[::1], float64[::1], float64[::1])),
    ("mismatch.likelihood.tangent_pass", "shafts", (Model, Motion, float64[:, ::1])),
    ("mismatch.name.gram", "injected", (
        float64[:, ::1], bool[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1],
        float64[:, ::1], float64[:, :, :])),
    ("concealed.plant", "bristle_stiffness", (float64[::1],)),
    ("mismatch.likelihood.along", "smooth_back", (
        float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],
        float64[:, ::1])),
    ("mismatch.likelihood.tangent_motion", "turns_over", (
        Model, Motion, float64[:, :, ::1], float64[:, ::1], float64[::1], UniTuple(float64, 3),
        bool[::1])),
    ("mismatch.likelihood.tangent_motion", "before_corrections", (
        float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[::1], float64, float64[::1],
        float64[:, ::1], float64[::1])),
    ("estimation.modelled", "contributions", (
        float64[::1], float64[::1], int64[::1], float64[:, ::1], float64[::1])),
    ("mismatch.likelihood.along", "played", (float64[::1], float64)),
    ("mismatch.likelihood.tangent_motion", "lags", (float64[::1],)),
    ("estimation.stage_one", "predict_one", (
        float64, float64, float64, float64, float64, float64, float64)),
    ("estimation.stage_one", "slopes_one", (
        float64, float64, float64, float64, float64, float64, float64, float64)),
    ("estimation.stage_one", "predict_one_euler", (
        float64, float64, float64, float64, float64, float64)),
    ("physics.own_term", "expressed_along", (float64[::1], float64[:, ::1], float64[::1])),
    ("physics.own_term", "expressed", (float64[::1], float64[::1])),
)
