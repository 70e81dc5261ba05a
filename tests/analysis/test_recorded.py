"""Recorded movements: what comes out is the movement that went in, or an error that names it."""

import make_reaches as reaches
import numpy as np
import pytest
import xarray

from jaxctrl.analysis._recorded import load_movements, trials

SPEED = 1.875  # peak speed of a minimum-jerk reach, in distances per duration


def table(ts, xs, ys, trial: object = 1):
    """Return a data set in long form, for one trial."""
    values = {"trial": [trial] * len(ts), "time": ts, "x": xs, "y": ys}
    return xarray.Dataset({name: ("samples", value) for name, value in values.items()})


def reach(duration=0.5, rate=200.0, rest=0.25, distance=0.1):
    """Return times (n,) and positions (n,) of a reach along x, without noise."""
    ts = np.arange(round((duration + 2 * rest) * rate) + 1) / rate
    return ts, distance * reaches.minimum_jerk(ts - rest, duration)


def speeds(data):
    """Return the speeds (trial, time) [m/s] by central differences."""
    return np.hypot(*np.moveaxis(data["hand"].differentiate("time").values, -1, 0))


def write(tmp_path, text, name="recorded.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_the_script_reproduces_the_file():
    assert reaches.FILE.read_text() == reaches.table()


def test_the_result_is_labelled_in_si_units_on_one_time_axis():
    data = load_movements(str(reaches.FILE))
    assert data["hand"].dims == ("trial", "time", "axis") and data["hand"].dtype == float
    np.testing.assert_array_equal(data["trial"], np.arange(1, 13))
    np.testing.assert_allclose(data["time"], np.arange(data.sizes["time"]) / 100, atol=1e-12)
    assert list(data["axis"].values) == ["x", "y"]
    units = {name: data[name].attrs["units"] for name in ("hand", "duration", "time", "axis")}
    assert units == {"hand": "m", "duration": "s", "time": "s", "axis": "1"}
    assert all(variable.attrs["long_name"] for variable in data.variables.values())


def test_trials_of_differing_duration_end_in_nan():
    data = load_movements(reaches.FILE)
    wanted = reaches.durations() + 2 * reaches.REST
    np.testing.assert_allclose(data["duration"], wanted, atol=1.5 / reaches.RATE)
    finite = np.isfinite(data["hand"]).all("axis").values
    np.testing.assert_array_equal(finite.sum(1), np.floor(data["duration"] * 100 + 1e-6) + 1)
    assert (np.diff(finite.astype(int), axis=1) <= 0).all() and finite.any(0).all()


def test_peak_speed_of_noisy_reaches_is_within_two_percent_after_filtering():
    true = SPEED * reaches.DISTANCE / reaches.durations()
    error = np.nanmax(speeds(load_movements(reaches.FILE)), axis=1) / true - 1
    assert abs(error).max() < 0.02 and abs(error.mean()) < 0.01
    raw = np.nanmax(speeds(load_movements(reaches.FILE, cutoff=None)), axis=1) / true - 1
    assert raw.max() > 0.1  # without the filter it is the noise that is measured


@pytest.mark.parametrize("duration", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("rate", [100.0, 240.0, 1000.0])
def test_peak_speed_without_noise_is_within_half_a_percent(duration, rate):
    ts, xs = reach(duration, rate)
    data = load_movements(table(ts, xs, 0 * xs))
    assert np.nanmax(speeds(data)) == pytest.approx(SPEED * 0.1 / duration, rel=5e-3)


@pytest.mark.parametrize("order", [2, 4, 8])
@pytest.mark.parametrize("cutoff", [5.0, 20.0, 45.0])
def test_at_the_cutoff_two_passes_leave_one_over_root_two_without_delay(cutoff, order):
    ts = np.arange(4001) / 1000
    wave = np.sin(2 * np.pi * cutoff * ts)
    data = load_movements(table(ts, wave, 0 * ts), rate=1000.0, cutoff=cutoff, order=order)
    middle = slice(1000, 3000)
    x = data["hand"].values[0, middle, 0]
    np.testing.assert_allclose(x, wave[middle] / np.sqrt(2), atol=1e-3)


def test_noise_beyond_the_new_nyquist_frequency_does_not_fold_into_the_movement():
    ts = np.arange(1001) / 1000
    data = load_movements(table(ts, 0.01 * np.sin(2 * np.pi * 98 * ts), 0 * ts))
    assert abs(data["hand"].values[0, 10:-10]).max() < 1e-5


def test_rest_stays_at_rest_and_steady_motion_steady_up_to_the_ends():
    ts = np.arange(201) / 200
    for velocity in (0.0, 0.3):
        data = load_movements(table(ts, 0.2 + velocity * ts, 0.1 + 0 * ts))
        np.testing.assert_allclose(speeds(data)[0], velocity, atol=1e-5)
        np.testing.assert_allclose(data["hand"][0, 0], [0.2, 0.1], atol=1e-6)
    ts, xs = reach(rest=0.0)  # as recordings that are cut at the onset
    data = load_movements(table(ts, xs, 0 * xs))
    wanted = 0.1 * reaches.minimum_jerk(data["time"].values, 0.5)
    np.testing.assert_allclose(data["hand"].values[0, :, 0], wanted, atol=3e-4)


def test_noise_at_rest_makes_little_speed_at_the_ends():
    rng = np.random.default_rng(0)
    ts = np.arange(201) / 200
    trials = [table(ts, *(3e-4 * rng.normal(size=(2, 201))), trial=i) for i in range(50)]
    ends = speeds(load_movements(xarray.concat(trials, "samples")))[:, [0, -1]]
    assert np.sqrt(np.mean(ends**2)) < 0.015  # m/s; 0.023 by a mirror through the last sample


def test_without_a_cutoff_the_recorded_samples_come_back():
    ts, xs = reach(rate=100.0)
    data = load_movements(table(ts + 7.0, xs, -xs), cutoff=None)
    np.testing.assert_allclose(data["hand"].values[0], np.stack([xs, -xs], axis=-1), atol=1e-12)


def test_csv_wide_long_and_netcdf_sources_agree(tmp_path):
    wanted = load_movements(reaches.FILE, cutoff=None)
    xy = wanted["hand"].to_dataset("axis")
    again = [wanted, xy, xy.transpose("time", "trial"), wanted.drop_vars("axis")]
    for name in ("hand.nc", "hand.nc4"):
        wanted.to_netcdf(tmp_path / name, engine="h5netcdf")
        again.append(tmp_path / name)
    again.append(tmp_path / "recorded.csv")
    frame = (
        xy.to_dataframe().reset_index().dropna().sort_values("time", kind="stable")
    )  # trials interleaved
    frame.to_csv(again[-1], index=False)
    again.append(xarray.Dataset.from_dataframe(frame.set_index(np.arange(len(frame)))))
    for source in again:
        data = load_movements(source, cutoff=None)
        xarray.testing.assert_allclose(data["hand"].drop_attrs(), wanted["hand"].drop_attrs())
        last = np.isfinite(data["hand"][..., 0]).sum("time") - 1
        np.testing.assert_allclose(data["duration"], last / 100)


def test_lengths_are_converted_to_metres():
    ts, xs = reach()
    wanted = load_movements(table(ts, xs, xs))
    for unit, size in (("cm", 100), ("mm", 1000)):
        data = load_movements(table(ts, size * xs, size * xs), length_unit=unit)
        xarray.testing.assert_allclose(data, wanted)
    stated = table(ts, xs, xs)
    stated["x"].attrs["units"] = "mm"
    with pytest.raises(ValueError, match=r"x is in 'mm', wanted 'm'; say so by `length_unit`"):
        load_movements(stated)
    stated = table(ts, xs, xs)
    stated["time"].attrs["units"] = "ms"
    with pytest.raises(ValueError, match=r"time is in 'ms', wanted 's'"):
        load_movements(stated)


def test_trials_keep_their_names_and_their_order(tmp_path):
    ts, xs = reach()
    trials = xarray.concat([table(ts, xs, xs, name) for name in ("left", "back")], "samples")
    assert list(load_movements(trials)["trial"].values) == ["left", "back"]
    trials.to_dataframe().to_csv(tmp_path / "named.txt")
    assert list(load_movements(tmp_path / "named.txt")["trial"].values) == ["left", "back"]


def test_short_gaps_are_spanned_and_missing_ends_shorten_the_trial():
    ts, xs = reach()
    ys = 0 * xs
    xs[[30, 31, 32, 100, 120]], ys[90], xs[:4], ys[-6:] = np.nan, np.inf, np.nan, np.nan
    data = load_movements(table(ts, xs, ys))
    assert float(data["duration"][0]) == pytest.approx(1.0 - 10 / 200)
    wanted = 0.1 * reaches.minimum_jerk(data["time"].values + 4 / 200 - 0.25, 0.5)
    np.testing.assert_allclose(data["hand"].values[0, :, 0], wanted, atol=2e-4)
    assert np.isfinite(data["hand"]).all()


def test_a_gap_is_spanned_up_to_the_length_stated():
    ts, xs = reach()
    xs[91:100] = np.nan  # 50 ms from one sample to the next
    data = load_movements(table(ts, xs, 0 * xs))
    assert np.nanmax(speeds(data)) == pytest.approx(SPEED * 0.2, rel=0.01)
    xs[100] = np.nan
    with pytest.raises(ValueError, match=r"trial 1: no sample for 0\.055 s from 0\.45 s on"):
        load_movements(table(ts, xs, 0 * xs))
    assert np.isfinite(load_movements(table(ts, xs, 0 * xs), max_gap=0.06)["hand"]).all()


def test_every_trial_that_cannot_be_used_is_named():
    ts, xs = reach()
    late = np.where(np.arange(len(ts)) == 50, ts[49], ts)
    never = np.where(ts == 0.5, np.nan, ts)
    trials = [
        table(ts, xs, xs, "good"),
        table(late, xs, xs, "late"),
        table(never, xs, xs, "never"),
        table(ts[:9], xs[:9], xs[:9], "few"),
        table(ts[:12] / 4, xs[:12], xs[:12], "short"),
        table(ts[::10], xs[::10], xs[::10], "slow"),
        table(ts[::20], xs[::20], xs[::20], "gap"),
    ]
    with pytest.raises(ValueError) as error:
        load_movements(xarray.concat(trials, "samples"))
    text = str(error.value)
    assert text.startswith("source: 6 of 7 trials cannot be used: ") and text.endswith(
        "; and 1 more"
    )
    for part in (
        "trial late: times must increase, but 0.245 s follows 0.245 s",
        "trial never: every time must be finite",
        "trial few: 9 finite samples, wanted at least 10",
        "trial short: lasts 0.01375 s, wanted at least 10 samples at 100 Hz",
        "trial slow: recorded at 20 Hz, too slowly for a cutoff of 10 Hz",
    ):
        assert part in text


TS, XS = reach()
GRID = xarray.Dataset(
    {"hand": (("trial", "time", "axis"), np.zeros((2, 99, 2)))}, {"time": np.arange(99) / 99}
)
WRONG = {
    "rate": (dict(rate=0.0), r"rate: got 0\.0, wanted a positive number \[Hz\]"),
    "cutoff at half the rate": (dict(cutoff=50.0), r"cutoff: got 50 Hz.* less than 50 Hz"),
    "cutoff zero": (dict(cutoff=0.0), r"cutoff: got 0 Hz"),
    "odd order": (dict(order=3), r"order: got 3, wanted an even number"),
    "gap": (dict(max_gap=np.nan), r"max_gap: got nan"),
    "length unit": (dict(length_unit="in"), r"length_unit: got 'in', wanted one of"),
    "no y": (dict(source=table(TS, XS, XS).drop_vars("y")), r"source: y missing; got trial, time"),
    "no times": (dict(source=GRID.drop_vars("time")), r"source: time missing"),
    "three axes": (dict(source=GRID.isel(axis=[0, 1, 1])), r"source: hand has the dim.*'axis': 3"),
    "one trial": (dict(source=GRID.isel(trial=0)), r"source: hand has the dimensions"),
    "mixed dimensions": (
        dict(source=GRID.drop_vars("hand").assign(x=("time", TS[:99]), y=("time", TS[:99]))),
        r"source: trial missing",
    ),
    "x over time alone": (
        dict(source=GRID["hand"].to_dataset("axis").rename({0: "x", 1: "y"}).isel(trial=0)),
        r"source: trial missing",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_arguments_are_named(what):
    arguments, message = WRONG[what]
    with pytest.raises(ValueError, match=message):
        load_movements(**{"source": table(TS, XS, XS)} | arguments)


def test_wrong_files_are_refused(tmp_path):
    header = "# comment\ntrial, time, x\n"
    with pytest.raises(ValueError, match=r"source: .*\.csv .*: y missing; got trial, time, x"):
        load_movements(write(tmp_path, header + "1,0,0\n"))
    header = "trial,time,x,y\n"
    with pytest.raises(ValueError, match="source: x must hold numbers"):
        load_movements(write(tmp_path, header + "1,0,left,0\n"))
    for text in ("", ",0,1,1\n"):
        with pytest.raises(ValueError, match="at least one sample, each with a trial"):
            load_movements(write(tmp_path, header + text))
    with pytest.raises(FileNotFoundError):
        load_movements(tmp_path / "none.csv")
    with pytest.raises(TypeError, match="source: got ndarray, wanted a path"):
        load_movements(np.zeros((3, 4)))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("empty.csv", b"", "is empty"),
        ("empty.nc", b"", "is empty"),
        ("comment.csv", b"# nothing\n", "cannot be read as CSV"),
        ("picture.csv", b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "cannot be read as CSV: 'utf-8'"),
        ("zeros.csv", bytes(500), "cannot be read as CSV"),
        ("prose.csv", b"so, it goes\n1,2,3,4\n1,2,3,4,5\n", "cannot be read as CSV"),
        ("points.csv", b"trial;time;x;y\n1;0;0;0\n", "y missing; .*separated by commas"),
        ("text.nc", b"hello", "cannot be read as netCDF"),
    ],
)
def test_a_foreign_file_is_named_with_what_to_do(tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"^source: .*{name} .*{says}") as caught:
        load_movements(tmp_path / name)
    assert len(str(caught.value)) < 600


def test_times_that_are_no_numbers_are_refused():
    late = GRID.assign_coords(time=np.arange(99).astype("timedelta64[ms]"))
    with pytest.raises(ValueError, match="source: time must hold numbers, got timedelta64"):
        load_movements(late)


def test_the_source_is_not_changed():
    source = table(TS, XS, XS)
    before = source.copy(deep=True)
    load_movements(source)
    xarray.testing.assert_identical(source, before)


def test_trials_come_without_what_lies_after_their_end():
    data = load_movements(reaches.FILE)
    seen = 0
    for i, (name, ts, path) in enumerate(trials(data)):
        assert name == data.trial.values[i] and path.shape == (ts.size, 2)
        assert np.isfinite(path).all() and abs(ts[-1] - float(data.duration[i])) < 0.011
        np.testing.assert_array_equal(path, data.hand.values[i, : ts.size])
        seen += 1
    assert seen == data.trial.size
    with pytest.raises(ValueError, match=r"^data: `hand`"):
        next(trials(xarray.Dataset()))
