"""A planned motion as a picture: what is demanded and predicted, and the limits."""

import numpy as np

from eha_monitor.quantity import Scale
from eha_monitor.reports.figure import (
    ERROR_LINE,
    OTHER,
    STAGE_ONE,
    STAGE_TWO,
    WIDTH,
    Figure,
    Level,
    Panel,
    Side,
    padded,
    scale_of,
)
from eha_monitor.settings.experiment import Experiment
from eha_monitor.settings.rig import Rig

_ROW, _FOOT = 130, 60  # CSS pixels
_X, _V, _P1, _P2 = 0, 1, 2, 3  # columns of a prediction


def motion_figure(x_d: np.ndarray, shown: np.ndarray, bounds: Experiment, rig: Rig, words: str
                  ) -> Figure:
    """Return position, speed, acceleration and pressures against time, with their limits.

    Parameters
    ----------
    x_d : (n,) demanded position, m, one value to a sample of the rig.
    shown : (n, N_OUTPUTS) what the model predicts, SI.
    words : what the motion is.
    """
    dt, rotary = rig.sample_time, rig.motion == "rotary"
    time = np.arange(len(x_d)) * dt
    length = "rad" if rotary else "m"
    v = shown[:, _V]
    rows = [("position", length, (bounds.lower, bounds.upper),
             ((shown[:, _X], "predicted", STAGE_ONE), (x_d, "demanded", OTHER))),
            ("velocity", f"{length}/s", (-bounds.speed, bounds.speed),
             ((v, "predicted", STAGE_ONE),)),
            ("acceleration", f"{length}/s²", (-bounds.acceleration, bounds.acceleration),
             ((np.gradient(v, dt), "predicted", STAGE_ONE),)),
            ("pressure", "Pa", (bounds.pressure,),
             ((shown[:, _P1], "chamber 1", STAGE_ONE), (shown[:, _P2], "chamber 2", STAGE_TWO)))]
    panels = []
    for i, (name, unit, limits, signals) in enumerate(rows):
        every = np.concatenate([np.array(limits), *(values for values, _, _ in signals)])
        last = i == len(rows) - 1
        panel = Panel(Side("time" if last else "", Scale(1.0, "s" if last else ""),
                           limits=(0.0, float(time[-1]))),
                      Side(name, scale_of(every, unit),
                           limits=padded(float(every.min()), float(every.max()), 0.1)))
        for values, label, colour in signals:
            panel.signal(time, values, label, colour, width=1.3,
                         legend=len(signals) > 1)
        for at in limits:
            panel.add(Level(at, "", ERROR_LINE, dash="dash"))
        panels.append(panel)
    return Figure(tuple(panels), words, (1.0,) * len(panels),
                  (WIDTH, _ROW * len(panels) + _FOOT))
