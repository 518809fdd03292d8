from contextlib import suppress
from dataclasses import replace

import h5py
import numpy as np
import pytest

from visadapt.recordings import Episode, RecordingError, read_recording, write_recording

ROWS = 37


def an_episode(rows=ROWS, seed=0, frames=True):
    rng = np.random.default_rng(seed)
    return Episode(
        time=np.arange(rows) * 0.05,
        action=rng.uniform(-1, 1, (rows, 1)).astype(np.float32),
        state=rng.normal(size=(rows, 4)),
        frame=rng.integers(0, 256, (rows, 10, 12), np.uint8) if frames else None,
        task_state=rng.normal(size=(rows, 2)),
    )


def assert_same(a, b):
    for name in ("time", "action", "state", "frame", "task_state"):
        left, right = getattr(a, name), getattr(b, name)
        if left is None:
            assert right is None
        else:
            assert left.dtype == right.dtype
            np.testing.assert_array_equal(left, right)


@pytest.fixture
def recording(tmp_path):
    """A good recording of three episodes."""
    path = tmp_path / "recording.h5"
    write_recording(path, [an_episode(ROWS + n, n) for n in range(3)])
    return path


class TestEpisode:
    def test_rows_of_samples(self):
        assert an_episode(rows=11).samples == 10

    @pytest.mark.parametrize("name", ["action", "state"])
    def test_a_value_that_is_not_finite_is_named_with_its_row(self, name):
        good = an_episode()
        values = getattr(good, name).copy()
        values[5, 0] = np.nan
        with pytest.raises(RecordingError, match=f"{name} is not finite in row 5"):
            replace(good, **{name: values})

    def test_a_clock_that_is_not_finite(self):
        time = np.arange(ROWS) * 0.05
        time[3] = np.nan
        with pytest.raises(RecordingError, match="time is not finite in row 3"):
            replace(an_episode(), time=time)

    @pytest.mark.parametrize("jump", [0.0, -0.2])
    def test_a_clock_that_does_not_run_forward(self, jump):
        time = np.arange(ROWS) * 0.05
        time[8:] += jump - 0.05
        with pytest.raises(RecordingError, match="clock does not run forward after row 7"):
            replace(an_episode(), time=time)

    @pytest.mark.parametrize("name", ["action", "state", "frame", "task_state"])
    def test_rows_that_do_not_match(self, name):
        good = an_episode()
        with pytest.raises(RecordingError, match=f"37 rows has 36 rows of {name}"):
            replace(good, **{name: getattr(good, name)[:-1]})

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"state": None, "frame": None}, "states or frames"),
            ({"action": np.zeros(ROWS)}, r"action has the shape \(37,\)"),
            ({"state": np.zeros((ROWS, 4), int)}, "state is of type int64"),
            ({"frame": np.zeros((ROWS, 10, 12))}, "frame is of type float64; uint8"),
            ({"time": np.zeros(0), "action": np.zeros((0, 1)), "state": np.zeros((0, 4))}, "at least one row"),
        ],
    )
    def test_what_makes_no_episode(self, change, message):
        with pytest.raises(RecordingError, match=message):
            replace(an_episode(), **change)


class TestRoundTrip:
    def test_all_comes_back_as_it_was(self, recording):
        back = read_recording(recording)
        assert len(back) == 3
        for n, episode in enumerate(back):
            assert_same(episode, an_episode(ROWS + n, n))

    def test_states_alone_and_frames_alone(self, tmp_path):
        path = tmp_path / "a.h5"
        for episode in (an_episode(frames=False), replace(an_episode(), state=None), an_episode(rows=1)):
            write_recording(path, [episode])
            assert_same(read_recording(path)[0], episode)

    def test_more_than_ten_episodes_keep_their_order(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, [an_episode(rows, frames=False) for rows in range(1, 14)])
        assert [episode.samples for episode in read_recording(path)] == list(range(13))

    def test_names_of_columns_are_kept(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, [an_episode()], ["x", "x_dot", "theta", "theta_dot"], ["command"])
        with h5py.File(path) as file:
            assert list(file.attrs["state_names"]) == ["x", "x_dot", "theta", "theta_dot"]
        with pytest.raises(RecordingError, match="2 names for 4 columns of state"):
            write_recording(path, [an_episode()], ["x", "theta"])
        with pytest.raises(RecordingError, match="are called x, x, theta, theta_dot; names that differ are right"):
            write_recording(path, [an_episode()], ["x", "x", "theta", "theta_dot"])

    def test_an_empty_list_names_no_columns(self, tmp_path):
        path, frames = tmp_path / "a.h5", np.zeros((38, 4, 5), np.uint8)
        write_recording(path, [replace(an_episode(rows=38), state=None, frame=frames)], [], ["command"])
        assert read_recording(path)[0].state is None


class TestBadFiles:
    """Each is one line, and says which file."""

    def rejects(self, path, message):
        with pytest.raises(RecordingError, match=message) as caught:
            read_recording(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)

    def test_a_missing_file(self, tmp_path):
        self.rejects(tmp_path / "no.h5", "no such file")

    def test_not_hdf5(self, tmp_path):
        path = tmp_path / "a.h5"
        path.write_text("time,x\n0,1\n")
        self.rejects(path, "not a readable HDF5 file")

    @pytest.mark.parametrize("kept", [0.1, 0.5, 0.9, 0.999])
    def test_a_torn_file(self, recording, kept):
        whole = recording.read_bytes()
        recording.write_bytes(whole[: int(kept * len(whole))])
        self.rejects(recording, "cut short")

    def test_damaged_bytes_are_never_read_as_data(self, recording):
        with h5py.File(recording) as file:
            state = file["episode_00001/state"]
            place = state.id.get_chunk_info(0).byte_offset
        content = bytearray(recording.read_bytes())
        content[place + 20] ^= 0xFF
        recording.write_bytes(content)
        self.rejects(recording, "episode_00001: 'state' is damaged")

    def test_hdf5_of_something_else(self, tmp_path):
        path = tmp_path / "a.h5"
        with h5py.File(path, "w") as file:
            file["state"] = np.zeros(3)
        self.rejects(path, "'format' is not 'visadapt recording'")

    def test_another_version(self, recording):
        with h5py.File(recording, "a") as file:
            file.attrs["version"] = 3
        self.rejects(recording, "version 3 of the format; this visadapt reads versions 1 to 2")

    def test_files_of_the_version_before_are_read(self, recording):
        with h5py.File(recording, "a") as file:
            file.attrs["version"] = 1
            del file["episode_00000/state"].attrs["sha256"]
        assert len(read_recording(recording)) == 3

    def test_attributes_of_fixed_length_as_other_programs_write_them(self, recording):
        with h5py.File(recording, "a") as file:
            file.attrs["format"] = np.bytes_(file.attrs["format"])
        assert len(read_recording(recording)) == 3

    @pytest.mark.parametrize("name", ["state", "frame"])
    def test_values_that_are_not_those_written(self, recording, name):
        with h5py.File(recording, "a") as file:
            file[f"episode_00001/{name}"][3] = 0
        self.rejects(recording, f"episode_00001: '{name}' is damaged")

    def test_names_that_are_not_those_written(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, [an_episode()], ["x", "x_dot", "theta", "theta_dot"])
        with h5py.File(path, "a") as file:
            file.attrs["state_names"] = ["theta", "theta_dot", "x", "x_dot"]
        self.rejects(path, "'state' is damaged")

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("format", 3),
            ("format", np.zeros(3)),
            ("version", np.ones(3)),
            ("version", "2"),
            ("state_names", 3),
            ("state_names", [1, 2, 3, 4]),
            ("state_names", np.zeros((2, 2))),
            ("state_names", "x"),
            ("state_names", h5py.Empty("f")),
            ("state_names", ["x", "x", "theta", "theta"]),
        ],
    )
    def test_attributes_of_another_kind_or_size(self, recording, name, value):
        with h5py.File(recording, "a") as file:
            file.attrs[name] = value
        self.rejects(recording, "version" if name == "version" else f"attribute '{name}' is not")

    @pytest.mark.parametrize("place", ["episode_00001", "episode_00001/time"])
    @pytest.mark.parametrize(
        "link", [h5py.ExternalLink("other.h5", "/there"), h5py.ExternalLink("/etc/passwd", "/"), h5py.SoftLink("/")]
    )
    def test_links_are_not_followed(self, recording, place, link):
        with h5py.File(recording.with_name("other.h5"), "w") as other, h5py.File(recording, "a") as file:
            file.copy(file[place], other, "there")
            del file[place]
            file[place] = link
        self.rejects(recording, "is a link to elsewhere; what it leads to belongs into the file itself")

    def test_values_in_another_file(self, recording):
        with h5py.File(recording, "a") as file:
            time = file["episode_00001/time"][()]
            del file["episode_00001/time"]
            recording.with_name("raw").write_bytes(time.tobytes())
            raw = [(str(recording.with_name("raw")), 0, time.nbytes)]
            file["episode_00001"].create_dataset("time", time.shape, time.dtype, external=raw)
        self.rejects(recording, "the values of 'time' are in another file")

    @pytest.mark.parametrize(("shape", "dtype"), [((10**10,), "f8"), ((38,), h5py.vlen_dtype(float)), ((38,), "O")])
    def test_a_dataset_of_impossible_size_or_kind(self, recording, shape, dtype):
        with h5py.File(recording, "a") as file:
            del file["episode_00001/time"]
            dtype = h5py.string_dtype() if dtype == "O" else dtype
            file["episode_00001"].create_dataset("time", shape, dtype, chunks=(10,))
        self.rejects(recording, "'time' is damaged")

    def test_damage_over_which_hdf5_never_ends(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, [an_episode(rows=12)], ["x", "x_dot", "theta", "theta_dot"], ["command"])
        content = bytearray(path.read_bytes())
        content[2561] = 8  # the free space of a heap
        path.write_bytes(content)
        self.rejects(path, "to read it ends the process, or takes far too long")

    def test_a_flipped_bit_anywhere_changes_nothing_that_is_read(self, tmp_path):
        path = tmp_path / "a.h5"
        whole = [an_episode(rows=12)]
        write_recording(path, whole, ["x", "x_dot", "theta", "theta_dot"], ["command"])
        content, rng = path.read_bytes(), np.random.default_rng(0)
        for place in rng.integers(0, len(content), 100):
            damaged = bytearray(content)
            damaged[place] ^= 1 << rng.integers(8)
            path.write_bytes(damaged)
            with suppress(RecordingError):
                assert_same(read_recording(path)[0], whole[0])

    @pytest.mark.parametrize("name", ["time", "action"])
    def test_a_missing_dataset(self, recording, name):
        with h5py.File(recording, "a") as file:
            del file[f"episode_00002/{name}"]
        self.rejects(recording, f"episode_00002 has no dataset '{name}'")

    def test_a_missing_episode(self, recording):
        with h5py.File(recording, "a") as file:
            del file["episode_00001"]
        self.rejects(recording, "episode_00001 is missing")

    def test_nan_says_episode_and_row(self, recording):
        with h5py.File(recording, "a") as file:
            file.attrs["version"] = 1
            values = file["episode_00001/state"][()]
            values[9, 2] = np.nan
            file["episode_00001/state"][...] = values
        self.rejects(recording, "episode_00001: state is not finite in row 9")

    def test_frames_of_another_size(self, recording):
        with h5py.File(recording, "a") as file:
            file.attrs["version"] = 1
            del file["episode_00002/frame"]
            file["episode_00002/frame"] = np.zeros((ROWS + 2, 5, 6), np.uint8)
        self.rejects(recording, r"episode_00002 has frame rows of shape \(5, 6\), the first episode of \(10, 12\)")


def test_a_failed_write_keeps_the_old_recording(recording):
    before = recording.read_bytes()
    with pytest.raises(RecordingError, match="at least one episode"):
        write_recording(recording, [])
    with pytest.raises(RecordingError, match="episode_00001 has state rows of shape None"):
        write_recording(recording, [an_episode(), replace(an_episode(), state=None)])
    assert recording.read_bytes() == before
    assert [path.name for path in recording.parent.iterdir()] == [recording.name]
