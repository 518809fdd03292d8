import pytest

from visadapt.systems import CartPole, FixedWing, Quadrotor
from visadapt.systems.parameter_file import ParameterFileError, load_parameters


def rig(tmp_path, text):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return load_parameters(path, CartPole)


def test_parameters_and_defaults(tmp_path):
    assert rig(tmp_path, "[parameters]\ncart_mass = 0.23\nmax_force = 2\n") == CartPole(cart_mass=0.23, max_force=2.0)


def test_an_empty_table_is_the_default(tmp_path):
    assert rig(tmp_path, "[parameters]\n") == CartPole()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[parameters]\ncart_mas = 1\n", "unknown key 'cart_mas' in .parameters.; there are cart_mass, pole_mass"),
        ("cart_mass = 1\n", "the table .parameters. is missing; it may hold cart_mass"),
        ("parameters = 1\n", "the table .parameters. is missing"),
        ("[parameters]\n[motor]\nkv = 1\n", "unknown key 'motor' outside .parameters."),
        ("[parameters]\npole_mass = -0.1\n", "pole_mass must be positive, got -0.1"),
        ("[parameters]\npole_mass = 0\n", "pole_mass must be positive, got 0"),
        ("[parameters]\ngravity = nan\n", "gravity must be finite, got nan"),
        ("[parameters]\ngravity = inf\n", "gravity must be finite, got inf"),
        ("[parameters]\ngravity = '9.8'\n", "gravity must be a number in SI units, got '9.8'"),
        ("[parameters]\ngravity = true\n", "gravity must be a number in SI units, got True"),
        ("[parameters\n", "not TOML"),
        (f"[parameters]\ngravity = {'1' * 400}\n", "gravity must be finite, got 1{30} "),
        (f"[parameters]\ngravity = {'1' * 5000}\n", "not TOML: Exceeds the limit"),
        ("[parameters]\ngravity = 1e39\n", r"gravity must be finite, got 1e.39 .at most 3.4e.38 is right"),
        (f"[parameters]\ngravity = {'[' * 3000}{']' * 3000}\n", "not TOML: maximum recursion depth"),
    ],
)
def test_one_line_names_file_and_key(tmp_path, text, message):
    with pytest.raises(ParameterFileError, match=f"rig.toml: .*{message}") as caught:
        rig(tmp_path, text)
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(ParameterFileError, match=r"none.toml: cannot be read: No such file"):
        load_parameters(tmp_path / "none.toml", CartPole)


@pytest.mark.parametrize(
    ("system", "text", "expected"),
    [
        (FixedWing, "mass = 2\nroll_aileron = -0.1\n", FixedWing(mass=2.0, roll_aileron=-0.1)),
        (Quadrotor, "mass = 0.8\nmax_thrust = 20\n", Quadrotor(mass=0.8, max_thrust=20.0)),
    ],
)
def test_a_vehicle_of_ones_own_is_a_toml_file(tmp_path, system, text, expected):
    path = tmp_path / "rig.toml"
    path.write_text(f"[parameters]\n{text}")
    assert load_parameters(path, system) == expected


@pytest.mark.parametrize(
    ("system", "text", "message"),
    [
        (FixedWing, "wingspan = 2", "unknown key 'wingspan' in .parameters.; there are mass, inertia_x"),
        (FixedWing, "span = -2", "fixed_wing: span must be positive, got -2.0"),
        (Quadrotor, "arm = 2", "unknown key 'arm' in .parameters.; there are mass, arm_length"),
        (Quadrotor, "mass = 0", "quadrotor: mass must be positive, got 0.0"),
    ],
)
def test_one_line_names_the_file_and_key_of_an_impossible_vehicle(tmp_path, system, text, message):
    path = tmp_path / "rig.toml"
    path.write_text(f"[parameters]\n{text}\n")
    with pytest.raises(ParameterFileError, match=f"rig.toml: {message}"):
        load_parameters(path, system)
