"""The answers of the commands in Python, as frozen records that a notebook shows.

```python
import eha_monitor as em

r = em.read("bags/hidden_friction")  # a bag; with a config also a CSV or a MAT file
d = em.diagnose(r)                   # as `eha-monitor diagnose`
d.effects                            # typed records
d.to_frame("fit")                    # tables, pandas
d.plot()                             # a matplotlib figure
d.to_dict()                          # the JSON that the command writes
```

[notebook.ipynb](notebook.ipynb) goes through all of it, executed.

- **Units.** Numbers are SI, in records, tables and channels. A config takes strings with a unit as
  well: `em.Config(rig={"mass": "20 kg", "area_1": "5.05 cm^2"})`.
- **Config.** Where a function takes a config, it takes an `em.Config`, a YAML file or a mapping.
  Without one it takes that with which the recording was read or simulated, effects and all; of a
  path, or of arrays of your own, it takes the paper's EHA, as the commands do.
- **Errors.** Bad input raises `em.InputError`, with the one line that the command prints. A
  recording that contradicts its config raises `em.ImplausibleError`, whose `corrected` is the
  config put right, where one can be.
- **Results do not change.** Records are frozen and their arrays cannot be written;
  `dict(...)`, `array.copy()` and `config.changed(...)` make what can. They can be pickled and
  copied.
- **Notebooks and threads.** Nothing is printed unless `progress=True` asks for a line. Nothing
  needs or touches an event loop. Threads may call; one calculates at a time, because a
  calculation uses all cores. For many bags use processes, or `eha-monitor estimate FOLDER`.
- **Numpy.** Import `eha_monitor` before numpy: it keeps BLAS to one thread, which else costs
  processor time (the numbers are the same). `import eha_monitor` itself takes milliseconds; what
  it needs is imported with the first call.
"""
