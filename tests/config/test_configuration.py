"""Structure and site files: every problem at once, with its place."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from monitor.config import configuration
from monitor.config.configuration import Configuration
from monitor.core import BadConfigurationError, MissingInputError, UserError
from tests.examples.beam import bridge

Load = Callable[[str], Configuration]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    def from_text(text: str) -> Configuration:
        path = tmp_path / "frame.toml"
        path.write_text(text, encoding="utf-8")
        return configuration.load(path)

    return from_text


def problems(load: Load, text: str) -> list[str]:
    with pytest.raises(BadConfigurationError) as caught:
        load(text)
    assert caught.value.exit_code == 78
    lines = str(caught.value).splitlines()
    assert all("frame.toml: " in line for line in lines), "every line names the file"
    return [line.split("frame.toml: ", 1)[1] for line in lines]


def assert_problem(load: Load, text: str, *words: str) -> None:
    told = " ".join(problems(load, text))
    assert all(word in told for word in words), told


def test_a_good_file_gives_model_channels_and_sensors(load: Load, frame_text: str) -> None:
    c = load(frame_text)
    assert c.channels == ("a1", "a2", "a3")
    np.testing.assert_array_equal(c.instrumented().sensor_matrix, np.eye(3))
    np.testing.assert_allclose(c.model().modes().frequencies_hz, [5.2, 16.3, 23.0], rtol=1e-3)
    np.testing.assert_allclose(c.instrumented().prior_std, [0.2, 0.2, 0.2, 0.05, 0.05, 0.05])
    assert (c.processing.window_s, c.processing.hop_s, c.processing.rate_hz) == (20.0, 5.0, 100.0)


def test_the_contracts_example_needs_nothing_else(load: Load) -> None:
    c = load(
        '[structure]\nkind = "shear_frame"\nmasses_kg = [1.0, 1]\nstiffness_n_per_m = [900.0, 800]\n'
        '[[sensors]]\nchannel = "top"\nfloor = 1\n'
    )
    assert (c.processing.rate_hz, c.processing.cutoff_hz) == (100.0, 40.0)
    assert (c.processing.window_s, c.processing.hop_s) == (400.0, 10.0)
    assert c.structure.damping_ratio == 0.01
    assert c.alarm.alarm_loss == 0.10


def test_sensors_pick_their_floor(load: Load, frame_text: str) -> None:
    c = load(frame_text.replace('channel = "a1"\nfloor = 1', 'channel = "a1"\nfloor = 3'))
    np.testing.assert_array_equal(c.instrumented().sensor_matrix[0], [0.0, 0.0, 1.0])


def test_every_problem_is_listed_at_once(load: Load, frame_text: str) -> None:
    text = (
        frame_text.replace("0.3253", "-0.3253")
        .replace("1514.8507", '"soft"')
        .replace("damping_ratio = 0.01", "damping_ratio = 1.5\ncolour = 7")
        .replace("window_s = 20.0", "window_s = 0")
        .replace("block_rows = 10", "block_rows = 1")
    )
    lines = problems(load, text + "\n[alarm]\nconfirm = 10\n")
    places = [
        "masses_kg.0",
        "stiffness_n_per_m.1",
        "damping_ratio",
        "colour",
        "window_s",
        "block_rows",
        "alarm.confirm",
    ]
    for place in places:
        assert sum(place in line for line in lines) == 1, (place, lines)
    assert len(lines) == len(places)


BARE = "; leave out the quotation marks"


@pytest.mark.parametrize(
    ("old", "new", "place", "wanted", "given"),
    [
        ("window_s = 20.0", 'window_s = "20.0"', "processing.window_s", "a number", 'the text "20.0"' + BARE),
        ("window_s = 20.0", 'window_s = "s3cret"', "processing.window_s", "a number", "text"),
        ("window_s = 20.0", "window_s = true", "processing.window_s", "a number", "true or false"),
        ("block_rows = 10", "block_rows = 10.0", "identification.block_rows", "a whole number", "a number, 10.0"),
        ('channel = "a1"', "channel = 1234", "sensors.0.channel", "text in quotation marks", "a whole number"),
        ('channel = "a1"', "channel = 2026-01-01", "sensors.0.channel", "text in quotation marks", "a date or time"),
        ("0.3253", '"0.3253"', "structure.masses_kg.0", "a number", 'the text "0.3253"' + BARE),
        ("[0.3253, 0.3514, 0.3129]", "0.3", "structure.masses_kg", "an array", "a number"),
        (
            "[processing]",
            "[[processing]]",
            "processing",
            "a table",
            "an array; a single table begins with [processing]",
        ),
    ],
)
def test_a_value_of_another_type_is_refused_with_what_was_given_and_what_is_wanted(
    load: Load, frame_text: str, old: str, new: str, place: str, wanted: str, given: str
) -> None:
    assert old in frame_text
    assert problems(load, frame_text.replace(old, new, 1)) == [f"{place}: must be {wanted}, and is {given}"]


def test_a_single_table_where_several_may_stand_is_told_the_brackets(load: Load, frame_text: str) -> None:
    text = frame_text[: frame_text.index("[[sensors]]")] + '[sensors]\nchannel = "a1"\nfloor = 1\n'
    assert problems(load, text) == [
        "sensors: must be an array, and is a table; one of several tables begins with [[sensors]]"
    ]


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ('[source]\nkind = "mcap"\nfiles = "a.mcap"\n', "source.files: must be an array, and is text"),
        (
            '[source]\nkind = "mqtt"\nhost = "h"\ntopic = "t"\nport = "1883"\n',
            'source.port: must be a whole number, and is the text "1883"',
        ),
        ("[output]\nkeep_gb = '3'\n", 'output.keep_gb: must be a number, and is the text "3"'),
        ("[log]\nlevel = 3\n", "log.level: Input should be 'debug'"),
    ],
)
def test_types_are_checked_in_the_tables_of_a_site_too(load: Load, frame_text: str, table: str, told: str) -> None:
    lines = problems(load, frame_text + "\n" + table)
    assert any(line.startswith(told) for line in lines), lines


def test_problems_between_tables_are_listed_at_once_too(load: Load, frame_text: str) -> None:
    text = frame_text.replace('channel = "a2"', 'channel = "a1"').replace("floor = 3", "floor = 4")
    text = text.replace("hop_s = 5.0", "hop_s = 0.13").replace(
        "block_rows = 10", 'block_rows = 10\nreference_channels = ["a9"]'
    )
    lines = problems(load, text + '\n[[effects]]\neffect = "magic"\nlocation = "frame"\n')
    for words in (("'a1'", "twice"), ("floor 4 of 3",), ("'a9'",), ("magic",), ("window_s and hop_s",)):
        assert sum(all(w in line for w in words) for line in lines) == 1, (words, lines)


@pytest.mark.parametrize("table", ["quality", "selection", "updating", "alarm", "site", "output"])
def test_unknown_keys_of_optional_tables_and_unknown_tables_are_refused(
    load: Load, frame_text: str, table: str
) -> None:
    assert_problem(load, f"{frame_text}\n[{table}]\nnonsense = 1\n", f"{table}.nonsense")
    assert_problem(load, f"{frame_text}\n[{table}s]\nx = 3\n", f"{table}s")


@pytest.mark.parametrize("key", ["min_range_k", "significance", "unevenness", "extrapolation"])
def test_a_key_of_temperature_without_effect_is_refused(load: Load, frame_text: str, key: str) -> None:
    assert_problem(load, f"{frame_text}\n[temperature]\n{key} = 1.0\n", f"temperature.{key}")


@pytest.mark.parametrize("table", ["structure", "sensors"])
def test_a_missing_table_is_named(load: Load, frame_text: str, table: str) -> None:
    renamed = frame_text.replace(f"[{table}]", "[site]")
    renamed = renamed.replace("[[sensors]]", "[[effects]]") if table == "sensors" else renamed
    assert_problem(load, renamed, table)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[structure]", "[structure]\nnonsense = 1", ("structure.nonsense",)),
        ("[[sensors]]", "[[sensors]]\nnonsense = 1", ("sensors.0.nonsense",)),
        ("[processing]", "[processing]\nnonsense = 1", ("processing.nonsense",)),
        ("[identification]", "[identification]\nnonsense = 1", ("identification.nonsense",)),
        ("0.3253", "0.0", ("masses_kg.0",)),
        ("0.3253", "nan", ("masses_kg.0",)),
        ("0.3253", "inf", ("masses_kg.0",)),
        ("2909.4511", "-1.0", ("stiffness_n_per_m.0",)),
        ("[0.3253, 0.3514, 0.3129]", "[]", ("masses_kg",)),
        ("[0.3253, 0.3514, 0.3129]", "[0.3253, 0.3514]", ("3 values for 2 masses",)),
        ("[0.093, 0.093, 0.1]", "[0.093, 0.093]", ("story_heights_m has 2 values for 3",)),
        ("damping_ratio = 0.01", "damping_ratio = 0", ("damping_ratio",)),
        ("damping_ratio = 0.01", "damping_ratio = 1", ("damping_ratio",)),
        ('"shear_frame"', '"tower"', ("structure.kind", "shear_frame")),
        ("floor = 1", "floor = 0", ("sensors.0.floor",)),
        ("floor = 1", "floor = 1.5", ("sensors.0.floor",)),
        ('channel = "a1"', 'channel = ""', ("sensors.0.channel",)),
        ("hop_s = 5.0", "hop_s = 25.0", ("hop_s is longer than window_s",)),
        ("hop_s = 5.0", "hop_s = -5.0", ("processing.hop_s",)),
        ("hop_s = 5.0", "hop_s = 0.001", ("hop_s",)),
        ("hop_s = 5.0", "hop_s = 5.0\ncutoff_hz = 50.0", ("cutoff_hz", "half of rate_hz")),
        ("hop_s = 5.0", "hop_s = 5.0\nrate_hz = 0", ("processing.rate_hz",)),
        ("hop_s = 5.0", "hop_s = 5.0\nrate_hz = inf", ("processing.rate_hz",)),
        ("block_rows = 10", 'variant = "N4SID"', ("identification.variant",)),
        ("block_rows = 10", "algorithm = 3", ("identification.algorithm",)),
        ("block_rows = 10", "max_order = 2", ("identification.max_order",)),
    ],
)
def test_values_out_of_range_are_named_with_their_place(
    load: Load, frame_text: str, old: str, new: str, words: tuple[str, ...]
) -> None:
    assert old in frame_text
    assert_problem(load, frame_text.replace(old, new, 1), *words)


@pytest.mark.parametrize("text", ["kind =", "[structure", "= 3", "\x00", "kind = 1\nkind = 2"])
def test_what_is_no_toml_is_named_with_its_line(load: Load, text: str) -> None:
    (line,) = problems(load, f"\n[site]\n{text}\n")
    assert "not a TOML file" in line and ("line 3" in line or "line 4" in line)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[alarm]\nalarm_loss = " + "9" * 10_000, "not a TOML file"),
        (f"[{'.'.join(['a'] * 20_000)}]", "nested too deeply"),
        ("[alarm]\nx = " + "[" * 100_000, "not a TOML file"),
    ],
    ids=["digits", "tables", "arrays"],
)
def test_what_no_reader_can_take_is_bad_configuration(load: Load, frame_text: str, text: str, says: str) -> None:
    (line,) = problems(load, f"{frame_text}\n{text}\n")
    assert says in line


def test_what_is_no_text_is_bad_configuration(tmp_path: Path) -> None:
    path = tmp_path / "frame.toml"
    path.write_bytes(b"\xff\xfe\x00[")
    with pytest.raises(BadConfigurationError, match=r"frame\.toml: not UTF-8"):
        configuration.load(path)


def test_a_missing_file_or_a_directory_is_missing_input(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(MissingInputError) as caught:
            configuration.load(path)
        assert caught.value.exit_code == 66
        assert str(path) in str(caught.value)


def test_ranges_become_the_prior_of_their_own_story_and_floor(load: Load, frame_text: str) -> None:
    ranges = (
        "masses_range_kg = [[0.30, 0.34], [0.35, 0.36], [0.3, 0.4]]\n"
        "stiffness_range_n_per_m = [[2000.0, 4000.0], [1500, 1600], [1000, 3000]]\n"
    )
    c = load(frame_text.replace("damping_ratio", ranges + "damping_ratio"))
    stiffness = [2000 / 4 / 2909.4511, 100 / 4 / 1514.8507, 2000 / 4 / 1897.6986]
    masses = [0.04 / 4 / 0.3253, 0.01 / 4 / 0.3514, 0.1 / 4 / 0.3129]
    np.testing.assert_allclose(c.instrumented().prior_std, [*stiffness, *masses])


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ("masses_range_kg = [[0.3, 0.4]]", ("masses_range_kg has 1 values for 3",)),
        ("masses_range_kg = [[0.3, 0.4], [0.3, 0.4], [0.3, 0.4, 0.5]]", ("masses_range_kg.2",)),
        ("masses_range_kg = [[-0.3, 0.4], [0.3, 0.4], [0.3, 0.4]]", ("masses_range_kg.0",)),
        ("masses_range_kg = [[0.4, 0.3], [0.3, 0.4], [0.3, 0.4]]", ("masses_range_kg",)),
        ("masses_range_kg = [[0.3, 0.3], [0.3, 0.4], [0.3, 0.4]]", ("masses_range_kg",)),
        ("stiffness_range_n_per_m = [[1000, 4000], [2000, 1000], [1, 2]]", ("stiffness_range_n_per_m",)),
    ],
)
def test_ranges_that_cannot_be_are_refused(load: Load, frame_text: str, ranges: str, words: tuple[str, ...]) -> None:
    assert_problem(load, frame_text.replace("damping_ratio", ranges + "\ndamping_ratio"), *words)


def effects(name: str, location: str, parameters: str) -> str:
    return f'\n[[effects]]\neffect = "{name}"\nlocation = "{location}"\nparameters = {{ {parameters} }}\n'


@pytest.mark.parametrize(
    ("stiffness", "words"),
    [
        ([3e-6, 2e-6, 2e-6], "below 0.2 Hz"),
        ([3e12, 2e12, 2e12], "beyond cutoff_hz"),
        ([3e200, 2e200, 2e200], "less than or equal"),
    ],
)
def test_a_frame_in_other_units_is_told(load: Load, frame_text: str, stiffness: list[float], words: str) -> None:
    assert_problem(load, re.sub(r"(stiffness_n_per_m = )\[.*?\]", rf"\g<1>{stiffness}", frame_text), words)


@pytest.mark.parametrize(
    ("processing", "selection"), [("cutoff_hz = 10.0", ""), ("cutoff_hz = 40.0", "min_frequency_hz = 20.0")]
)
def test_a_frame_of_which_one_mode_lies_in_the_band_is_taken(
    load: Load, frame_text: str, processing: str, selection: str
) -> None:
    text = frame_text.replace("[processing]", f"[processing]\n{processing}")
    assert load(f"{text}\n[selection]\n{selection}\n").model().modes().frequencies_hz[1] == pytest.approx(
        16.3, rel=1e-3
    )


def test_two_forces_of_one_channel_are_told(load: Load, frame_text: str) -> None:
    force = '\n[[inputs]]\nchannel = "f"\nfloor = 1\n'
    assert load(frame_text + force).inputs[0].channel == "f"
    assert_problem(load, frame_text + force + force.replace("1", "2"), "'f' stands twice")


@pytest.mark.parametrize("correction", [-900.0, -900.5])
def test_a_frame_whose_correction_takes_its_whole_stiffness_would_not_stand(load: Load, correction: float) -> None:
    frame = '[structure]\nkind = "shear_frame"\nmasses_kg = [1.0]\nstiffness_n_per_m = [900.0]\n'
    sensor = '[[sensors]]\nchannel = "top"\nfloor = 1\n'
    assert_problem(load, f"{frame}stiffness_correction_n_per_m = [[{correction}]]\n{sensor}", "would not stand")


def test_effects_extend_the_model(load: Load, frame_text: str) -> None:
    bare = load(frame_text).model()
    weak = load(frame_text + effects("stiffness_change", "story 2", "relative = -0.2")).model()
    expected = bare.structure.stiffness_n_per_m * [1.0, 0.8, 1.0]
    np.testing.assert_allclose(weak.stiffness_matrix(), bare.with_stiffness(expected).stiffness_matrix())
    soft = load(frame_text + effects("joint_flexibility", "frame", "girder_to_column_ratio = 10")).model()
    assert (soft.modes().frequencies_hz < bare.modes().frequencies_hz).all()
    both = effects("stiffness_change", "story 2", "relative = -0.2")
    both += effects("joint_flexibility", "frame", "girder_to_column_ratio = 10.0")
    assert len(load(frame_text + both).model().effects) == 2


@pytest.mark.parametrize(
    ("name", "location", "parameters", "words"),
    [
        ("magic", "frame", "", ("unknown effect 'magic'", "joint_flexibility")),
        ("stiffness_change", "story 4", "relative = -0.1", ("story 4", "3 stories")),
        ("stiffness_change", "story 0", "relative = -0.1", ("story 0",)),
        ("stiffness_change", "floor 1", "relative = -0.1", ("floor 1", "story N")),
        ("stiffness_change", "story two", "relative = -0.1", ("story two",)),
        ("stiffness_change", "frame 7", "relative = -0.1", ("frame 7",)),
        ("stiffness_change", "story 1", "loss = 0.1", ("relative",)),
        ("stiffness_change", "story 1", "relative = -0.1, more = 1", ("relative",)),
        ("stiffness_change", "story 1", "", ("relative",)),
        ("stiffness_change", "story 1", "relative = 'much'", ("effects.0.parameters.relative",)),
        ("stiffness_change", "story 1", "relative = nan", ("relative",)),
        ("stiffness_change", "story 1", "relative = -1.0", ("relative",)),
        ("stiffness_change", "story 1", "relative = -1.5", ("relative",)),
        ("joint_flexibility", "frame", "girder_to_column_ratio = -1.0", ("girder_to_column_ratio",)),
        ("joint_flexibility", "frame", "girder_to_column_ratio = 0.0, more = 2", ("girder_to_column_ratio",)),
    ],
)
def test_effects_that_cannot_be_are_refused(
    load: Load, frame_text: str, name: str, location: str, parameters: str, words: tuple[str, ...]
) -> None:
    assert_problem(load, frame_text + effects(name, location, parameters), *words)


def test_a_problem_that_holds_a_semicolon_stays_one_line(load: Load, frame_text: str) -> None:
    """Messages are parted at semicolons, which the messages of effects have themselves."""
    lines = problems(load, frame_text + effects("stiffness_change", "floor 1", "relative = -0.1"))
    assert len(lines) == 1, lines


def test_every_shipped_file_is_sound() -> None:
    shipped = sorted((Path(__file__).parents[2] / "recordings").glob("*.toml"))
    shipped = [path for path in shipped if path.name != "index.toml"]
    assert len(shipped) >= 4
    for path in shipped:
        frequencies = configuration.load(path).model().modes().frequencies_hz
        assert (frequencies > 0).all()


def test_a_user_error_is_no_other_exception() -> None:
    assert issubclass(BadConfigurationError, UserError) and not issubclass(BadConfigurationError, ValueError)


NODES = """
[[nodes]]
name = "ground"
[[nodes]]
z = 3.0
dof_x = 1
[[lines]]
nodes = [1, 2]
story = 1
[[lines]]
nodes = [1, 2]
story = 2
[[lines]]
nodes = [2, 1]
story = 3
"""


def test_a_structure_is_drawn_by_its_nodes_and_lines(load: Load, frame_text: str) -> None:
    drawing = load(frame_text + NODES).drawing
    np.testing.assert_array_equal(drawing.points, [[0, 0, 0], [0, 0, 3.0]])
    np.testing.assert_array_equal(drawing.dofs, [[-1, -1, -1], [0, -1, -1]])
    np.testing.assert_array_equal(drawing.lines, [[0, 1], [0, 1], [1, 0]])
    assert (drawing.stories.tolist(), drawing.names) == ([0, 1, 2], ("ground", ""))


def test_a_frame_without_nodes_is_drawn_by_its_heights(load: Load, frame_text: str) -> None:
    drawing = load(frame_text).drawing
    assert drawing.points.shape == (16, 3), "four columns, three floors and the ground"
    np.testing.assert_array_equal(drawing.dofs[:, 0], np.repeat([0, 1, 2, -1], 4))
    assert (drawing.dofs[:, 1:] == -1).all()
    top = drawing.points[drawing.lines[drawing.stories == 0]][:, :, 2]
    assert np.ptp(top, axis=1) == pytest.approx(0.093), "story 1 is the top one, as high as the file says"


def test_a_drawing_that_does_not_fit_the_structure_is_refused(load: Load, frame_text: str) -> None:
    wrong = NODES.replace("dof_x = 1", "dof_x = 4").replace("nodes = [2, 1]", "nodes = [2, 5]")
    wrong = wrong.replace("story = 2", "story = 9")
    assert_problem(
        load,
        frame_text + wrong,
        "node 2 has dof_x = 4 of 3 degrees of freedom",
        "line 3 ends at node 5 of 2",
        "line 2 has story = 9 of 3",
        "no line has story = 2, so its loss would not be drawn",
    )


def test_stories_are_called_by_their_names_in_both_kinds(load: Load, frame_text: str) -> None:
    named = frame_text.replace("damping_ratio", 'story_names = ["roof", "middle", "foot"]\ndamping_ratio', 1)
    assert load(named).story_names == ("story 1 (roof)", "story 2 (middle)", "story 3 (foot)")
    assert load(frame_text).story_names == tuple(f"story {j} from the top" for j in (1, 2, 3))
    assert_problem(load, named.replace('"roof", ', ""), "story_names has 2 values for 3 masses")


def test_the_size_of_a_structure_is_counted_by_its_kind(load: Load, frame_text: str, tmp_path: Path) -> None:
    assert load(frame_text).size_words == "3 stories"
    bridge(tmp_path / "bridge.toml")
    assert configuration.load(tmp_path / "bridge.toml").size_words == "6 stiffnesses, 12 degrees of freedom"
