from dataclasses import replace

import numpy as np

from tests.recorded import HEADER, STATES, a_table, load, refuses, write
from visadapt.recordings import Episode, write_recording


class TestRoundTrip:
    def episodes(self):
        tables = [a_table(rows=rows, seed=rows) for rows in (11, 41, 23)]
        return [
            Episode(
                time=table["time"],
                action=table["command"][:, None],
                state=np.column_stack([table[name] for name in STATES]),
            )
            for table in tables
        ]

    def assert_same(self, recording):
        assert recording.warnings == ()
        for back, episode in zip(recording.episodes, self.episodes(), strict=True):
            np.testing.assert_allclose(back.time, episode.time, atol=1e-12)
            np.testing.assert_array_equal(back.state, episode.state)
            np.testing.assert_array_equal(back.action, episode.action)

    def test_csv(self, file):
        table = {"episode": np.repeat([0, 1, 2], [11, 41, 23])}
        for name in HEADER:
            table[name] = np.concatenate([a_table(rows=rows, seed=rows)[name] for rows in (11, 41, 23)])
        write(file, table)
        self.assert_same(load(file))

    def test_hdf5_with_and_without_names(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, self.episodes())
        self.assert_same(load(path))
        order = [2, 3, 0, 1]
        turned = [replace(episode, state=episode.state[:, order]) for episode in self.episodes()]
        write_recording(path, turned, [STATES[index] for index in order], ["command"])
        self.assert_same(load(path))

    def test_hdf5_with_names_of_its_own(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, self.episodes(), ["cart", "x_dot", "phi", "theta_dot"], ["u"])
        self.assert_same(load(path, columns={"x": "cart", "theta": "phi"}))
        refuses("column 'x' is missing; it has time, cart", path)
        refuses("has no column 'pole' for theta; it has", path, columns={"x": "cart", "theta": "pole"})

    def test_hdf5_that_does_not_fit(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, [replace(episode, state=episode.state[:, :3]) for episode in self.episodes()])
        refuses("a.h5, episode 0: 3 columns of state and 1 of action", path)
        frames = [replace(e, state=None, frame=np.zeros((len(e.time), 2, 2), np.uint8)) for e in self.episodes()]
        write_recording(path, frames)
        refuses("holds frames alone; states are needed", path)
        path.write_bytes(path.read_bytes()[:500])
        refuses("a.h5: not a readable HDF5 file, or cut short", path)
