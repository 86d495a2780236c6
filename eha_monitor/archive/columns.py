"""The columns of the table: name, type, what it says.  docs/archive.md is held to this."""

from dataclasses import dataclass

from eha_monitor.indicators.indicator import WORDS

SCHEMA = "eha_monitor/archive/1"
PARAMETERS = ("B", "beta_e")
COMMANDS = ("estimate", "diagnose")
# Column -> indicator of the health (:mod:`eha_monitor.indicators`), whose unit it ends with.
INDICATORS = {"leakage_mL_min": "leakage", "free_air_percent": "free_air",
              "friction_N": "friction", "pump_efficiency_percent": "pump_efficiency",
              "drive_lag_ms": "drive_lag"}


@dataclass(frozen=True)
class Column:
    """One column; ``kind``: text, number, count, flag, time, effects or rig.

    ``only`` names the command whose table has it; both have it where it is empty.
    """

    name: str
    kind: str
    words: str
    only: str = ""


def _of_parameter(name: str) -> tuple[Column, ...]:
    return (
        Column(name, "number", f"{name}, SI, as `estimate` reports it"),
        Column(f"{name}_stddev", "number", "its standard deviation"),
        Column(f"{name}_unit", "text", "unit of both"),
        Column(f"{name}_status", "text", "converged, not_excited, diverged or no_data"),
        Column(f"{name}_doubt", "text", "why a model mismatch biases it; empty if none does"),
    )


def _of_diagnosis(name: str) -> tuple[Column, ...]:
    return tuple(
        Column(f"{name}_{when}{end}", "number", words, "diagnose")
        for when, said in (("before", f"{name} without the named effects, SI"),
                           ("after", f"{name} with the named effects, SI"))
        for end, words in (("", said), ("_stddev", "its standard deviation")))


def _of_indicator(name: str, indicator: str) -> tuple[Column, ...]:
    return (
        Column(name, "number", f"{WORDS[indicator]} at the conditions of the config's `health`; "
               "also where a single recording is too uncertain to report it"),
        Column(f"{name}_stddev", "number", "its standard deviation"),
        Column(f"{name}_noise", "number", "the part of it that differs from one recording to "
               "the next"),
        Column(f"{name}_status", "text", "available, in_doubt, none_named, cannot_be_told or "
               "needs_config"),
    )


COLUMNS = (
    Column("bag", "text", "path of the bag below the folder"),
    Column("start", "time", "first sample by the stamps of the messages, UTC; empty where "
           "they are no dates"),
    Column("duration_s", "number", "length of the recording"),
    Column("samples", "count", "samples on the grid"),
    *_of_parameter("B"),
    *_of_parameter("beta_e"),
    Column("temperature_C", "number", "oil at the end of the recording, where it is measured"),
    Column("B_reference", "number", "B at `viscosity.reference_temperature`, where the "
           "temperature is measured"),
    Column("B_reference_stddev", "number", "its standard deviation"),
    *(column for name, indicator in INDICATORS.items()
      for column in _of_indicator(name, indicator)),
    Column("alarm", "text", "worst level of the four alarms at the end of the recording: OK, "
           "STALE, not judged, WARN, ERROR"),
    Column("viscous_damping_high", "text", "level of this alarm"),
    Column("viscous_damping_low", "text", "level of this alarm"),
    Column("bulk_modulus_high", "text", "level of this alarm"),
    Column("bulk_modulus_low", "text", "level of this alarm"),
    Column("alarm_message", "text", "message of the worst alarm"),
    Column("model", "text", "consistent, mismatch or not_judged"),
    Column("model_balance", "text", "what the mismatch points to"),
    Column("model_message", "text", "the same in a sentence"),
    Column("verdict", "text", "verdict of `diagnose`", "diagnose"),
    Column("verdict_message", "text", "the same in a sentence", "diagnose"),
    *(Column(f"balance_{name}", "number", f"share of the {name} in the disagreement",
             "diagnose") for name in ("force", "flow", "drive", "sensor")),
    Column("regime", "text", "in which regime they disagree", "diagnose"),
    *(Column(f"probability_{name}", "number", f"probability that {words}, 0 to 1", "diagnose")
      for name, words in (("consistent", "nothing is missing"),
                          ("unexplained", "an unidentified effect is missing"))),
    Column("rig_data", "rig", "numbers of the rig that the recording contradicts: key, "
           "configured, value, stddev, unit, probability, statement, indistinguishable_from",
           "diagnose"),
    Column("effects", "effects", "what was left out: name, balance, size, statement, "
           "probability, log_evidence, intervals_s, indistinguishable_from, parameters (name, "
           "value, stddev, unit)", "diagnose"),
    *_of_diagnosis("B"),
    *_of_diagnosis("beta_e"),
    Column("losses", "text", "what was lost or repaired in reading"),
    Column("error", "text", "why processing failed; empty where it did not"),
    Column("wall_s", "number", "processing time"),
    Column("answered", "time", "time of processing, UTC"),
    Column("gone", "flag", "the bag is no longer in the folder"),
    Column("stamp", "text", "digest of names, sizes and times of the bag's files"),
    Column("made_with", "text", "digest of config, options and source of the program"),
)


def columns_of(command: str) -> tuple[Column, ...]:
    """Return the columns of the table of a command."""
    return tuple(column for column in COLUMNS if column.only in ("", command))
