import base64
import html
import json
import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest

from visadapt import diagnosis as package
from visadapt.diagnosis.report.html import as_html, write_report
from visadapt.diagnosis.report.text import as_text, sentence
from visadapt.diagnosis.result import (
    VERDICTS,
    Box,
    Cause,
    Chart,
    Curve,
    Diagnosis,
    Estimate,
    FigureData,
    FilmFrames,
    Gap,
    Pixels,
    PolicyTerms,
    Prediction,
    Push,
    Ranked,
    RecordingSummary,
    Region,
    Where,
)
from visadapt.diagnosis.words import MISFIT, estimate, interval, number

DATA_URL = re.compile(r"data:image/png;base64,([\w+/=]+)")
STATES = ("x", "x_dot", "theta", "theta_dot")
SCHEMA = json.loads((Path(next(iter(package.__path__))) / "schema.json").read_text())
MEASURE = "root mean square error of x, theta 0.5 s ahead, in units of the noise, on held-out episodes"
SETTINGS = {"recording": "run.csv", "seed": "0", "versions": "visadapt 0.1.0"}


def some_figures(velocities=True):
    rng = np.random.default_rng(0)
    time = 1.2 + np.arange(41) * 0.05
    truth = np.column_stack(
        [0.3 * np.sin(2 * time), 0.6 * np.cos(2 * time), 0.05 * np.sin(5 * time), 0.25 * np.cos(5 * time)]
    )
    drift = 0.2 * (time - time[0])[:, None] ** 2 * [1, 2, 0.3, 0.6]
    measured = truth + 0.01 * rng.normal(size=truth.shape)
    if not velocities:
        measured[:, [1, 3]] = np.nan
    centres = np.linspace(-0.7, 0.7, 15)
    bump = np.where((centres > 0.05) & (centres < 0.45), -2.0, 0.0)
    error = np.full(15, 0.15)
    seconds = np.linspace(0.05, 0.5, 10)
    frequency = np.linspace(0.1, 10, 60)
    return FigureData(
        predictions=tuple(Prediction(episode, time, measured, truth + drift, truth) for episode in (3, 5, 8)),
        profiles=(
            Chart("x", "m", "force on the cart", "N", centres, curves(bump, 0.1 * bump, error=error)),
            Chart("time", "s", "force on the cart", "N", centres + 1, curves(0.1 * bump, 0.1 * bump, error=error)),
        ),
        growth=Chart(
            *("predicted ahead", "s", "error", "", seconds),
            curves(1 + 8 * seconds**2, 1 + 0.3 * seconds, 1 + 0.5 * seconds, np.ones(10)),
        ),
        spectrum=Chart(
            *("frequency", "Hz", "force on the cart", "N2/Hz", frequency),
            curves(1 / frequency, 0.05 + 0 * frequency),
        ),
    )


def curves(*values, error=None):
    labels = ("simulator", "with the causes", "black box", "noise")
    return tuple(Curve(label, each, error) for label, each in zip(labels, values, strict=False))


PATCH = Cause(
    "friction_patch",
    {
        "start": Estimate(0.1021, "m", (0.0913, 0.1121)),
        "end": Estimate(0.402, "m", (0.391, 0.411)),
        "coefficient": Estimate(7.83, "N s/m", (6.91, 8.77)),
    },
    probability=0.982,
    gap_closed=0.61,
    gap_reopened=0.58,
)
DELAY = Cause("actuator_delay", {"delay": Estimate(0.0312, "s", (0.0281, 0.0343))}, 0.94, 0.33, 0.31)
GAIN = Cause(
    "actuator_gain", {"scale": Estimate(0.8, "1", (0.77, 0.83))}, 0.52, 0.93, 0.9, indistinguishable_from=("cart_mass",)
)
MASS = Cause(
    "cart_mass",
    {"scale": Estimate(1.27, "1", (1.2, math.nan))},
    0.46,
    0.93,
    0.9,
    indistinguishable_from=("actuator_gain",),
)
MASS_ALONE = replace(MASS, indistinguishable_from=())
DARKER = Cause("brightness", {"gain": Estimate(0.7, "1", (math.nan, 0.71))}, 1.0, 0.999, 0.999)
REGION = Region("x", 0.1, 0.4, 0.8, 0.0004)


def a_diagnosis(verdict, **changes):
    """A plausible diagnosis for each verdict."""
    common: dict = {
        "system": "cartpole",
        "recording": RecordingSummary(10, 1000, 0.05),
        "where": Where(
            {"actuation": 0.2, "dynamics": 0.8, "sensing": 0.0, "camera": 0.0},
            {"x": 0.5, "x_dot": 0.2, "theta": 0.2, "theta_dot": 0.1},
            (REGION,),
        ),
        "gap": Gap(MEASURE, 6.4, 1.21, 1.02, 1.4, 0.965),
        "figures": some_figures(),
        "policy": PolicyTerms((0.12, 0.01), (2.5, 2.0), (0.04, 0.03), (0.3, 0.2)),
        "next_experiment": "",
    }
    own: dict[str, dict] = {
        "identified": {
            "causes": (PATCH, DELAY),
            "ranking": (
                Ranked(("actuator_delay", "friction_patch"), 0.97, 0.965),
                Ranked(("friction_patch",), 0.02, 0.6),
            ),
            "warnings": ("run3.csv, row 31 (line 32): rows are missing here; the episode was split",),
        },
        "ambiguous": {
            "causes": (GAIN, MASS),
            "ranking": (Ranked(("actuator_gain",), 0.52, 0.93), Ranked(("cart_mass",), 0.46, 0.93)),
            "next_experiment": "Let the pole swing with the motor off for 10 s: its pull then moves "
            "a heavier cart less, and a weaker motor does not matter.",
        },
        "unexplained": {
            "causes": (),
            "partial": (MASS,),
            "ranking": (Ranked(("coulomb_friction",), 0.6, 0.38), Ranked((), 0.0, 0.0)),
            "gap": Gap(MEASURE, 6.4, 4.5, 1.02, 1.5, 0.35),
            "next_experiment": "Drive slowly over x from 0.1 to 0.4 m in both directions.",
        },
        "no_gap": {
            "causes": (),
            "ranking": (Ranked((), 0.96, 0.0), Ranked(("viscous_friction",), 0.02, 0.01)),
            "gap": Gap(MEASURE, 1.03, 1.03, 1.02, 1.04, math.nan),
            "where": Where(
                dict.fromkeys(("actuation", "dynamics", "sensing", "camera"), 0.0),
                {"x": 0.5, "x_dot": math.nan, "theta": 0.5, "theta_dot": math.nan},
            ),
            "figures": some_figures(velocities=False),
        },
    }
    return Diagnosis(**(common | {"verdict": verdict} | own[verdict] | changes))


every_verdict = pytest.mark.parametrize("verdict", VERDICTS)


class TestResult:
    @every_verdict
    def test_the_json_is_as_the_schema_says(self, verdict):
        content = json.loads(json.dumps(a_diagnosis(verdict).to_json(), allow_nan=False))
        jsonschema.Draft202012Validator(SCHEMA).validate(content)

    def test_the_schema_is_valid(self):
        jsonschema.Draft202012Validator.check_schema(SCHEMA)

    def test_keys_and_their_order_are_the_contract(self):
        content = a_diagnosis("identified").to_json()
        assert list(content) == [
            "schema", "system", "recording", "verdict", "where", "causes", "ranking", "gap", "next_experiment",
            "warnings",
        ]  # fmt: skip
        assert list(content["where"]) == ["stages", "states", "regions", "pushes", "pixels"]
        assert content["where"]["regions"] == [
            {"variable": "x", "from": 0.1, "to": 0.4, "share": 0.8, "p_value": 0.0004}
        ]
        assert content["causes"][1] == {
            "effect": "actuator_delay",
            "parameters": {"delay": {"value": 0.0312, "unit": "s", "ci90": [0.0281, 0.0343]}},
            "probability": 0.94,
            "gap_closed": 0.33,
            "gap_reopened": 0.31,
            "slight": False,
            "indistinguishable_from": [],
        }
        assert list(content["gap"]) == ["measure", "before", "after", "floor", "black_box", "closed"]

    def test_what_is_not_finite_is_null(self):
        content = a_diagnosis("ambiguous").to_json()
        assert content["causes"][1]["parameters"]["scale"]["ci90"] == [1.2, None]
        assert a_diagnosis("no_gap").to_json()["where"]["states"]["x_dot"] is None

    def test_numbers_of_numpy_are_plain(self):
        gap = Gap(MEASURE, *np.array([6.4, 1.21, 1.02, 1.4, 0.965], np.float32))
        recording = RecordingSummary(*np.array([3, 100, 1]))
        json.dumps(a_diagnosis("identified", gap=gap, recording=recording).to_json(), allow_nan=False)

    def test_shares_may_pass_one_by_a_rounding_error(self):
        diagnosis = a_diagnosis("identified", causes=(replace(DELAY, probability=1.0000000000000002),))
        assert diagnosis.to_json()["causes"][0]["probability"] == 1

    def test_the_schema_refuses_causes_where_there_are_none(self):
        content = a_diagnosis("identified").to_json() | {"verdict": "no_gap"}
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.Draft202012Validator(SCHEMA).validate(content)

    @pytest.mark.parametrize(
        ("changes", "message"),
        [({"verdict": "maybe"}, "'maybe'; there are identified"), ({"causes": ()}, "does not go with 0 causes")],
    )
    def test_contradictions_are_refused(self, changes, message):
        with pytest.raises(ValueError, match=message):
            replace(a_diagnosis("identified"), **changes)


class TestWords:
    @pytest.mark.parametrize(
        ("verdict", "text"),
        [
            (
                "identified",
                "Friction patch (start 0.102 m, end 0.402 m, coefficient 7.8 N s/m) and actuator delay (delay "
                "0.0312 s) close 96 % of the gap to the simulator.",
            ),
            (
                "ambiguous",
                "Either actuator gain (scale 0.800) or cart mass (scale 1.27) closes 93 to 96 % of the gap to the "
                "simulator; this recording cannot tell which.",
            ),
            (
                "unexplained",
                "Something acts that no known effect explains: the most probable of them close 35 % of the gap, "
                "with a black box 91 %; it shows most at x from 0.10 to 0.40 m.",
            ),
            (
                "no_gap",
                "No gap: the simulator predicts this recording as well as its noise allows (error 1.03, noise 1.02).",
            ),
        ],
    )
    def test_the_verdict_in_a_sentence(self, verdict, text):
        assert sentence(a_diagnosis(verdict)) == text

    @pytest.mark.parametrize(
        ("after", "text"),
        [
            (6.4, "none closes any of the gap;"),
            (1.3, "close 95 % of the gap, and what is left is"),
        ],
    )
    def test_what_is_unexplained(self, after, text):
        gap = Gap(MEASURE, 6.4, after, 1.02, after, (6.4 - after) / (6.4 - 1.02))
        assert text in sentence(a_diagnosis("unexplained", gap=gap))

    def test_repeated_readings_beside_which_there_is_no_gap(self):
        gap = Gap("error", 1.0, 1.0, 1.0, 1.0, math.nan)
        dropout = Cause("dropout", {"rate": Estimate(0.013, "1", (0.005, 0.03))}, 1.0, math.nan)
        text = sentence(a_diagnosis("identified", causes=(dropout,), gap=gap))
        assert text == "Dropout (rate 0.013) explains the readings that are repeated."

    def test_a_camera_s_causes_explain_pixels_and_the_others_the_gap_of_the_motion(self):
        where = replace(a_diagnosis("identified").where, pixels=Pixels(0.17, 0.3, False))
        found = a_diagnosis("identified", causes=(DARKER, MASS_ALONE), where=where)
        assert sentence(found) == (
            "Brightness (gain 0.700) explains the pixels to within 0.17 grey levels; cart mass (scale 1.27) closes "
            "96 % of the gap to the simulator."
        )
        assert "closes 100 % of the pixels' misfit alone" in as_text(found)
        assert "gap closed in the motion" in as_text(found)

    def test_lost_frames_beside_a_camera_s_fault_explain_readings_where_the_gap_is_the_pixels(self):
        drop = Cause("frame_drop", {"rate": Estimate(0.2, "1", (0.156, 0.253))}, 1.0, math.nan)
        where = replace(a_diagnosis("identified").where, pixels=Pixels(0.17, 0.3, False))
        gap = Gap(MISFIT, 47.0, 0.3, 0.1, 0.3, 0.995)
        text = sentence(a_diagnosis("identified", causes=(DARKER, drop), where=where, gap=gap))
        assert text == (
            "Brightness (gain 0.700) closes 100 % of the gap to the simulator; frame drop (rate 0.200) explains the "
            "readings that are repeated."
        )

    def test_one_cause_is_sure_and_two_are_open(self):
        text = sentence(a_diagnosis("ambiguous", causes=(PATCH, GAIN, MASS)))
        assert re.match(r"Friction patch \(.*\) and either actuator gain \(.*\) or cart mass \(.*\) close 96 %", text)

    def test_one_that_stands_for_two(self):
        one, two, three = replace(GAIN, indistinguishable_from=("friction_patch", "cart_mass")), PATCH, MASS
        two, three = (replace(cause, indistinguishable_from=(GAIN.effect,)) for cause in (two, three))
        text = sentence(a_diagnosis("ambiguous", causes=(one, two, three)))
        either = r"Either actuator gain \(.*\), or friction patch \(.*\) and cart mass \(.*\)"
        assert re.match(rf"{either} closes 93 to 96 %", text)

    def test_one_that_stands_for_two_of_which_one_may_be_another(self):
        alike = {
            "quadratic_drag": ("viscous_friction", "coulomb_friction", "spring"),
            "viscous_friction": ("quadratic_drag", "spring"),
            "coulomb_friction": ("quadratic_drag",),
            "spring": ("quadratic_drag", "viscous_friction"),
        }
        causes = tuple(Cause(name, {}, 0.5, 0.9, indistinguishable_from=others) for name, others in alike.items())
        text = sentence(a_diagnosis("ambiguous", causes=causes))
        either = "Either quadratic drag, or viscous friction and coulomb friction, or spring and coulomb friction"
        assert text.startswith(f"{either} closes")

    @pytest.mark.parametrize(
        ("value", "text"),
        [(0, "0"), (0.0123456, "0.0123"), (1234.5, "1234"), (2.5e-7, "2.50e-07"), (math.nan, "unknown")],
    )
    def test_numbers(self, value, text):
        assert number(value) == text

    def test_digits_follow_the_interval(self):
        assert estimate(Estimate(2.12345, "N", (1.93, 2.31))) == "2.12 N"
        assert interval(Estimate(2.12345, "N", (1.93, 2.31))) == "1.93 to 2.31 N"
        assert interval(Estimate(2.12345, "1", (1.93, math.nan))) == "1.93 to open"
        assert estimate(Estimate(213.4, "N", (150.0, 270.0))) == "210 N"

    @every_verdict
    def test_the_terminal_shows_everything(self, verdict):
        diagnosis = a_diagnosis(verdict)
        text = as_text(diagnosis)
        assert text.startswith(f"{verdict}: {sentence(diagnosis)}\n")
        for cause in diagnosis.causes:
            assert cause.effect in text
            assert all(f"{name} = " in text for name in cause.parameters)
        for line in (diagnosis.next_experiment, *diagnosis.warnings):
            assert line in text
        for value in ("2.50", "0.0400", "0.520", "0.270"):  # L, the distance of commands, the bounds
            assert value in text
        assert "nan" not in text

    @pytest.mark.parametrize(("p_value", "says"), [(0.0004, "(p = 0.0004)"), (0.0, "(p < 1e-09)")])
    def test_pushes_and_how_likely_chance_makes_them(self, p_value, says):
        push = Push(0, "cart_force", 1.2, 1.9, 4.0, "N", 1.6, (1.2, 2.0), p_value)
        found = a_diagnosis("unexplained")
        found = replace(found, where=replace(found.where, regions=(), pushes=(push,)))
        (line,) = (line for line in as_text(found).splitlines() if "pushed from 1.20 to 1.90 s" in line)
        assert line.endswith(says)
        page = as_html(found, SETTINGS)
        assert says.strip("()") in html.unescape(page)
        assert "No stretch of a state" not in page


class Page(HTMLParser):
    """Tags, attributes and text of a page; every tag must be closed."""

    VOID = ("meta", "link", "img", "br", "input")

    def __init__(self, text):
        super().__init__()
        self.open: list[str] = []
        self.tags, self.attributes, self.words = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@cache
def page_of(verdict):
    """The page of such a diagnosis, whose figures take long to draw."""
    return as_html(a_diagnosis(verdict), SETTINGS)


class TestPage:
    @every_verdict
    def test_is_complete_and_self_contained(self, verdict):
        diagnosis = a_diagnosis(verdict)
        page = Page(page_of(verdict))
        assert "script" not in page.tags
        links = [value for name, value in page.attributes if name in ("src", "href", "xlink:href")]
        assert all(link.startswith("#") for link in links)
        assert page.tags.count("svg") == 7
        text = " ".join(" ".join(page.words).split())
        for piece in (sentence(diagnosis), diagnosis.next_experiment, *diagnosis.warnings, *SETTINGS.values()):
            assert piece in text
        assert "nan" not in re.sub(r"<svg.*?</svg>", "", page_of(verdict), flags=re.DOTALL).split()

    def test_what_explains_a_part_of_it_is_shown_and_is_no_cause(self):
        diagnosis = a_diagnosis("unexplained")
        ((name, one),) = MASS.parameters.items()
        text = " ".join(Page(page_of("unexplained")).words)
        assert "What explains a part of it" in text
        assert f"{name} {estimate(one)} {interval(one)}" in text
        assert f"Partly     cart_mass: probability {MASS.probability:.2f}" in as_text(diagnosis)
        assert "partial" not in diagnosis.to_json()

    def test_a_film_is_scrubbed_in_the_page_itself(self):
        rng = np.random.default_rng(0)
        frames = rng.integers(0, 256, (2, 100, 100, 120), dtype=np.uint8)
        film = FilmFrames(frames[0], frames[1], 0.05 * np.arange(100), np.full(100, 3), 0.5, rng.random((100, 120)))
        pixels = Pixels(4.2, 0.5, True, (Box(10, 20, 40, 30, 0.8),))
        where = replace(a_diagnosis("unexplained").where, pixels=pixels)
        diagnosis = a_diagnosis("unexplained", where=where, figures=replace(some_figures(), film=film))
        text = as_html(diagnosis, SETTINGS)
        page = Page(text)
        assert len(text) < 10e6
        assert "4.2 grey levels, most at columns 10 to 40 and rows 20 to 30" in text
        assert ("max", "99") in page.attributes
        assert '"episode 3, 4.95 s"' in text
        assert "left: 8.33%; top: 20.00%; width: 25.00%; height: 10.00%" in text
        pictures = [
            cv2.imdecode(np.frombuffer(base64.b64decode(found), np.uint8), -1) for found in DATA_URL.findall(text)
        ]
        assert np.array_equal(pictures[0].reshape(frames[0].shape), frames[0])
        assert [picture.shape[:2] for picture in pictures[1:]] == [(10000, 120), (100, 120)]
        assert not re.search(r"(?:https?:)?//[a-z]", DATA_URL.sub("", text).replace("http://www.w3.org", ""))

    def test_figures_are_images_in_the_page_s_colours(self):
        for svg in re.findall(r"<svg.*?</svg>", page_of("identified"), re.DOTALL):
            assert ElementTree.fromstring(svg.replace("xlink:href", "href")).find("title").text
            assert "var(--before)" in svg
            assert not re.search(r"(?:fill|stroke): #", svg)

    def test_without_figures(self):
        assert Page(as_html(a_diagnosis("identified", figures=FigureData()), {})).tags.count("svg") == 0

    def test_foreign_text_is_escaped(self):
        odd = a_diagnosis("identified", warnings=("<b>&.csv: odd",), figures=FigureData())
        page = as_html(odd, {"recording": "<i>.csv"})
        assert "&lt;b&gt;&amp;.csv: odd" in page
        assert "&lt;i&gt;.csv" in page

    def test_the_same_diagnosis_gives_the_same_page(self):
        assert as_html(a_diagnosis("identified"), SETTINGS) == page_of("identified")

    def test_is_written(self, tmp_path):
        path = tmp_path / "new" / "report.html"
        write_report(path, a_diagnosis("identified", figures=FigureData()), SETTINGS)
        assert path.read_text().startswith("<!doctype html>")
