import json

import pytest

from visadapt.storage.run_folder import RunError, alone_in, once, open_run, read_json, write_json

SETTINGS = {"seed": 0, "spread": (0.1, 0.2), "out": None, "budget": 1000}


def test_a_folder_in_which_a_run_works_is_closed_to_others_until_it_ends(tmp_path):
    folder = tmp_path / "run"
    with alone_in(folder), pytest.raises(RunError, match="another process runs in this folder"), alone_in(folder):
        pass
    with alone_in(folder):
        assert list(folder.iterdir()) == []


class TestOpening:
    def test_settings_and_versions_stand_beside_the_results(self, tmp_path):
        open_run(tmp_path / "new" / "run", SETTINGS)
        written = json.loads((tmp_path / "new" / "run" / "settings.json").read_text())
        assert written["settings"] == {"seed": 0, "spread": [0.1, 0.2], "out": None, "budget": 1000}
        assert written["versions"].keys() >= {"python", "torch", "numpy"}

    def test_the_same_settings_go_on(self, tmp_path):
        open_run(tmp_path, SETTINGS)
        before = (tmp_path / "settings.json").read_bytes()
        open_run(tmp_path, dict(reversed(SETTINGS.items())))
        assert (tmp_path / "settings.json").read_bytes() == before

    @pytest.mark.parametrize(
        ("change", "names"),
        [({"seed": 1}, "seed"), ({"seed": 1, "spread": (0.1, 0.3)}, "seed, spread"), ({"more": 1}, "more")],
    )
    def test_other_settings_are_refused_and_what_differs_is_named(self, tmp_path, change, names):
        open_run(tmp_path, SETTINGS)
        before = (tmp_path / "settings.json").read_bytes()
        with pytest.raises(RunError, match=rf"other settings \({names}\)") as caught:
            open_run(tmp_path, SETTINGS | change)
        assert str(tmp_path) in str(caught.value)
        assert "\n" not in str(caught.value)
        assert (tmp_path / "settings.json").read_bytes() == before

    def test_a_setting_that_is_gone_is_named(self, tmp_path):
        open_run(tmp_path, SETTINGS)
        with pytest.raises(RunError, match=r"\(budget\)"):
            open_run(tmp_path, {key: value for key, value in SETTINGS.items() if key != "budget"})

    @pytest.mark.parametrize("content", ["[]", "3", "null", '{"settings": []}', "{}", "{" * 3000, "\xff"])
    def test_settings_of_another_shape(self, tmp_path, content):
        (tmp_path / "settings.json").write_text(content, encoding="latin-1")
        with pytest.raises(RunError, match=f"^{tmp_path / 'settings.json'}: (no|holds no)") as caught:
            open_run(tmp_path, SETTINGS)
        assert "\n" not in str(caught.value)


class TestOnce:
    def test_it_is_made_once_and_read_from_then_on(self, tmp_path):
        made = []

        def make():
            made.append(1)
            return {"score": 0.1 + 0.2, "survived": 3}

        first = once(tmp_path / "score.json", make)
        second = once(tmp_path / "score.json", make)
        assert first == second == {"score": 0.1 + 0.2, "survived": 3}
        assert len(made) == 1

    def test_one_that_fails_leaves_nothing_and_is_made_again(self, tmp_path):
        def fails():
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            once(tmp_path / "score.json", fails)
        assert not list(tmp_path.iterdir())
        assert once(tmp_path / "score.json", lambda: {"a": 1}) == {"a": 1}


class TestJson:
    def test_a_torn_file_is_named_in_one_line(self, tmp_path):
        path = tmp_path / "score.json"
        write_json(path, {"a": [1, 2, 3]})
        path.write_text(path.read_text()[:-4])
        with pytest.raises(RunError, match=f"^{path}: not complete JSON") as caught:
            read_json(path)
        assert "\n" not in str(caught.value)

    def test_what_cannot_be_written_leaves_the_old_file(self, tmp_path):
        path = tmp_path / "score.json"
        write_json(path, {"a": 1})
        with pytest.raises(TypeError):
            write_json(path, {"a": 2, "b": object()})
        assert read_json(path) == {"a": 1}
        assert list(tmp_path.iterdir()) == [path]

    def test_what_is_not_finite_is_null_for_strict_readers(self, tmp_path):
        def refuse(constant):
            raise AssertionError(constant)

        path = tmp_path / "metrics.json"
        nan, inf = float("nan"), float("inf")
        write_json(path, {"speed": nan, "scores": [{"speed": -inf}, (inf, 0.5)]})
        assert json.loads(path.read_text(), parse_constant=refuse) == {
            "speed": None,
            "scores": [{"speed": None}, [None, 0.5]],
        }

    def test_settings_that_are_not_finite_are_still_the_same_settings(self, tmp_path):
        open_run(tmp_path, {"limit": float("inf")})
        open_run(tmp_path, {"limit": float("inf")})
