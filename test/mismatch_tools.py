"""Recordings with hidden effects, fitted without and with them, for the tests of the diagnosis."""

from dataclasses import dataclass
from functools import lru_cache

from eha_monitor.concealed.cases import Case
from eha_monitor.concealed.generate import nominal_config, recording_of
from eha_monitor.mismatch.data.experiment import Experiment, experiment_of
from eha_monitor.mismatch.likelihood.fit import Fit
from eha_monitor.mismatch.name.base import first_fit, settle, with_effect
from eha_monitor.mismatch.name.starts import screen, starts_of
from eha_monitor.recordings.recording import Recording
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


def experiment_with(recording: Recording, settings) -> Experiment:
    return experiment_of([recording], settings)


@lru_cache(maxsize=16)
def fitted(*effects: str, motion: str = "short", told: bool = True, seed: int = 3,
           strength: float = 1.0) -> Fitted:
    """Fit a concealed case, without its effects and told them."""
    case = Case("test", tuple((name, strength) for name in effects), motion=motion, seed=seed)
    channels, time = recording_of(case)
    recording = Recording(time[1] - time[0], channels, 0, "case")
    experiment = experiment_with(recording, settings_from_tree(nominal_config(case), "nominal"))
    before = after = first_fit(experiment)
    for name in effects if told else ():
        best = screen(experiment, after, starts_of(name, experiment))[0]
        after = settle(experiment, with_effect(after, best.start, best.amplitudes))
    return Fitted(recording, experiment, before, after)
