"""Recordings with hidden effects, fitted without and with them, for the tests of the diagnosis."""

from dataclasses import dataclass
from functools import lru_cache

from eha_monitor.concealed.cases import Case
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.diagnose import diagnose
from eha_monitor.mismatch.diagnosis import Diagnosis
from eha_monitor.mismatch.likelihood.fit import Fit, with_unknowns
from eha_monitor.mismatch.name.nominal import nominal
from eha_monitor.mismatch.name.refit import settled
from eha_monitor.mismatch.name.starts import starts_of
from eha_monitor.prove.oracle import RigNumbers, looked
from eha_monitor.recordings.recording import Recording
from eha_monitor.settings import Settings
from eha_monitor.settings.load import settings_from_tree


@dataclass(frozen=True)
class Fitted:
    """A recording, the nominal model's fit and that with the effects told."""

    recording: Recording
    experiment: Experiment
    before: Fit
    after: Fit

    @property
    def evidence(self) -> dict[str, float]:
        gain = self.after.log_likelihood - self.before.log_likelihood
        return dict.fromkeys(self.after.named, gain / max(len(self.after.named), 1))


def recorded(case: Case) -> tuple[Recording, Settings]:
    """Return the recording of a concealed case, and the config that knows nothing of it."""
    channels, time = recording_of(case)
    return (Recording(time[1] - time[0], channels, 0, "case"),
            settings_from_tree(nominal_config(case), "nominal"))


def nominal_fit(experiment: Experiment) -> Fit:
    """Return the nominal model, fitted to the end."""
    return nominal(experiment)[1]


def case_of(*effects: str, **options) -> Case:
    """Return a case of 6 s with effects at full strength."""
    return Case("test", tuple((name, 1.0) for name in effects), motion="short", seed=3, **options)


def diagnosed(*effects: str, samples: int = 6000, **options) -> Diagnosis:
    """Diagnose a case of 6 s, or its first samples, with effects at full strength."""
    recording, settings = recorded(case_of(*effects, **options))
    return diagnose([recording.part(0, samples)], settings)


@lru_cache(maxsize=16)
def fitted(*effects: str, motion: str = "short", told: bool = True, seed: int = 3,
           strength: float = 1.0) -> Fitted:
    """Fit a concealed case, without its effects and told them."""
    recording, settings = recorded(Case("test", tuple((name, strength) for name in effects),
                                        motion=motion, seed=seed))
    experiment, before = nominal(experiment_of([recording], settings))
    after = before
    for name in effects if told else ():
        after = looked(RigNumbers(experiment), after, starts_of(name, experiment))
        after = settled(experiment, with_unknowns(experiment, after))
    return Fitted(recording, experiment, before, after)
