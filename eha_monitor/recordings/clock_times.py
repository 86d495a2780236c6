"""Dates and times of day, as loggers write them, as stamps."""

import numpy as np

DAY = np.timedelta64(24, "h")
# Of a date with slashes the one is tried that all rows fit; within a day both give the same.
FORMATS = ("ISO8601", "%d.%m.%Y %H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S.%f",
           "%m/%d/%Y %H:%M:%S", "%d/%m/%Y %H:%M:%S.%f", "%d/%m/%Y %H:%M:%S",
           "%m/%d/%Y %I:%M:%S.%f %p", "%H:%M:%S.%f", "%H:%M:%S")
MOST = 0.5  # of the rows at least must be such a time
LOOKED_AT = 200  # rows that tell the format


def stamps_of(cells) -> np.ndarray:
    """Return (n,) datetime64[ns] in UTC of text cells, NaT where a cell is no such time.

    Times of day count from 1970 on and go on over midnight.

    Parameters
    ----------
    cells : pandas Series of n texts.
    """
    import pandas

    nothing = np.full(len(cells), np.datetime64("NaT"), dtype="datetime64[ns]")
    text = cells.str.replace(",", ".", regex=False)
    some = text.iloc[:LOOKED_AT]
    for form in FORMATS:
        if _read(pandas, some, form).notna().mean() <= MOST:
            continue
        found = _read(pandas, text, form)
        stamps = found.dt.tz_localize(None).to_numpy(dtype="datetime64[ns]")
        return _days(stamps) if form.startswith("%H") else stamps
    return nothing


def _read(pandas, text, form: str):
    return pandas.to_datetime(text, format=form, errors="coerce", utc=True)


def _days(stamps: np.ndarray) -> np.ndarray:
    """Return times of day as times since 1970, the day after midnight being the next one."""
    good = ~np.isnat(stamps)
    day = stamps.astype("datetime64[D]")
    since = stamps - np.where(good, day, np.datetime64("1970-01-01", "D"))
    own = since[good].astype(np.int64)
    half = DAY.astype("timedelta64[ns]").astype(np.int64) // 2
    whole = np.concatenate([[0], np.cumsum(np.diff(own) < -half)]) if len(own) else own
    out = np.full(len(stamps), np.datetime64("NaT"), dtype="datetime64[ns]")
    out[good] = (own + whole * 2 * half).astype("datetime64[ns]")
    return out
