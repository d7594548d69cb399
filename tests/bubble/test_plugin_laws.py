"""Laws of the user's own: found by path, module or entry point, refused with the reason, sent to spawned workers."""

from __future__ import annotations

import pickle
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import EntryPoint
from multiprocessing import get_context
from operator import methodcaller
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar.config import load_config
from en4dvar.plumbing.errors import ConfigError
from en4dvar_bubble import REGISTRY, BubbleModel, NeoHookeanKelvinVoigt, get_law, simulate
from en4dvar_bubble.laws import loading
from en4dvar_bubble.settings import BubbleSettings

YEOH = r'''
from en4dvar_bubble import ConstitutiveLaw
from en4dvar_bubble.laws.parameters import ALPHA, MU, G

class Yeoh(ConstitutiveLaw):
    r"""$W = \tfrac G2[I + \tfrac\alpha2 I^2]$, $I = I_1 - 3$."""
    title = "Yeoh"
    parameters = (G, ALPHA, MU)

    def strain_energy_rate(self, stretch, p):
        I = stretch**-4.0 + 2 * stretch**2 - 3
        return 2 * p.G * (1 + p.alpha * I) * (stretch - stretch**-5.0)
'''
VALUES = {"G": 5e3, "alpha": 0.03, "mu": 0.1, "R0": 5e-7}
TIMES = np.linspace(0, 40e-6, 81)


@pytest.fixture
def yeoh(tmp_path):
    path = tmp_path / "yeoh.py"
    path.write_text(YEOH)
    return path


def limited(text, name):
    """The law with the neo-Hookean one as its parent where ``name`` is zero."""
    text = text.replace("import ConstitutiveLaw", "import ConstitutiveLaw, NeoHookeanKelvinVoigt")
    return text.replace('"Yeoh"\n', f'"Yeoh"\n    limits = ((NeoHookeanKelvinVoigt, {{"{name}": 0.0}}),)\n')


def write(tmp_path, body, header="from en4dvar_bubble import *\nfrom en4dvar_bubble.laws.parameters import *\n"):
    path = tmp_path / "mine.py"
    path.write_text(header + body)
    return f"{path}:Mine"


class TestFinding:
    def test_path_relative_to_the_working_directory(self, yeoh, monkeypatch):
        monkeypatch.chdir(yeoh.parent)
        law = get_law("./yeoh.py:Yeoh")
        assert (law.name, law.title) == ("Yeoh", "Yeoh")
        assert [p.name for p in law.parameters] == ["G", "alpha", "mu"]

    def test_path_relative_to_the_yaml_file(self, yeoh, monkeypatch):
        monkeypatch.chdir("/")
        settings = BubbleSettings.model_validate({"law": "./yeoh.py:Yeoh"}, context={"base": yeoh.parent})
        assert settings.law == f"{yeoh}:Yeoh"
        assert BubbleModel.from_settings(settings).law.name == "Yeoh"

    def test_it_is_the_law_it_says(self, yeoh):
        """A trajectory of the energy form equals the built-in closed form of the same law."""
        own = simulate(f"{yeoh}:Yeoh", VALUES, TIMES)
        built_in = simulate("quadratic-kelvin-voigt", VALUES, TIMES)
        np.testing.assert_allclose(own.R, built_in.R, rtol=1e-6)

    def test_module_and_class(self):
        assert get_law("en4dvar_bubble.laws.kelvin_voigt:GentKelvinVoigt").name == "gent-kelvin-voigt"
        with pytest.raises(ConfigError, match="did you mean 'GentKelvinVoigt'"):
            get_law("en4dvar_bubble.laws.kelvin_voigt:GentKelvinVoight")
        with pytest.raises(ConfigError, match="cannot be imported"):
            get_law("no_such_package.laws:Gent")

    def test_entry_point(self, monkeypatch):
        entries = {
            "installed": EntryPoint("installed", "en4dvar_bubble.laws.kelvin_voigt:GentKelvinVoigt", loading.GROUP),
            "broken": EntryPoint("broken", "no_such_package:Law", loading.GROUP),
        }
        monkeypatch.setattr(loading, "installed", lambda group: entries if group == loading.GROUP else {})
        assert get_law("installed").name == "gent-kelvin-voigt"
        found = loading.available()
        assert found["installed"].__name__ == "GentKelvinVoigt"
        assert "no_such_package" in str(found["broken"])
        with pytest.raises(ConfigError, match="did you mean 'installed'"):
            get_law("instaled")

    def test_a_law_without_a_name_has_that_of_its_class_not_of_its_parent(self, tmp_path):
        body = "class Mine(NeoHookeanKelvinVoigt):\n    pass\n"
        assert get_law(write(tmp_path, body)).name == "Mine"
        assert type("Local", (NeoHookeanKelvinVoigt,), {})().name == "Local"
        assert not {"Mine", "Local"} & set(REGISTRY)
        assert REGISTRY["neo-hookean-kelvin-voigt"] is NeoHookeanKelvinVoigt

    def test_an_edited_file_is_loaded_again(self, yeoh):
        first = get_law(f"{yeoh}:Yeoh")
        yeoh.write_text(YEOH.replace('"Yeoh"', '"other"'))
        assert (first.title, get_law(f"{yeoh}:Yeoh").title) == ("Yeoh", "other")


class TestRefusing:
    def refused(self, name, *words):
        with pytest.raises(ConfigError) as caught:
            get_law(name)
        for word in words:
            assert word in str(caught.value), str(caught.value)

    def test_file_missing(self, yeoh):
        self.refused(f"{yeoh.parent}/yoeh.py:Yeoh", "yoeh.py: no such file", "yeoh.py")

    def test_class_missing(self, yeoh):
        self.refused(f"{yeoh}:Yeo", "yeoh.py: no class 'Yeo'", "did you mean 'Yeoh'")

    def test_class_not_named(self, yeoh):
        self.refused("yeoh.py", "unknown law 'yeoh.py'", "my_law.py:ClassName")

    def test_not_a_law(self, tmp_path):
        self.refused(write(tmp_path, "class Mine:\n    pass\n"), "mine.py:Mine", "not a subclass")
        self.refused(write(tmp_path, "Mine = 3\n"), "mine.py:Mine", "not a subclass")

    def test_file_that_raises(self, tmp_path):
        self.refused(write(tmp_path, "x = 1 / 0\n"), "mine.py:3: ZeroDivisionError")
        self.refused(write(tmp_path, "class Mine(:\n"), "mine.py:3: SyntaxError")

    def test_neither_and_both(self, tmp_path):
        self.refused(write(tmp_path, "class Mine(ConstitutiveLaw):\n    pass\n"), "defines neither", "Liquid")
        both = "class Mine(ConstitutiveLaw):\n" + "".join(
            f"    def {method}(self, stretch, p):\n        return p.mu * stretch\n"
            for method in ("stress", "strain_energy_rate")
        )
        self.refused(write(tmp_path, both), "defines both")

    @pytest.mark.parametrize(
        ("returned", "words"),
        [
            ("p.modulus * stretch", ("stress(stretch, p)", "AttributeError", "mine.py:5")),
            ("p.mue * stretch", ("p has no 'mue'; did you mean 'mu'?",)),
            ("stretch if stretch > 1 else -stretch", ("write np.where instead of if", "mine.py:5")),
            ("p.mu[:, 0]", ("stress(stretch, p)", "shape (3,)", "(3, 4)")),
            ("stretch[:2]", ("shape (2,)",)),
            ("None", ("object",)),
            ("stretch + 1j", ("complex128",)),
        ],
    )
    def test_method_that_fails(self, tmp_path, returned, words):
        body = f"class Mine(ConstitutiveLaw):\n    def stress(self, stretch, p):\n        return {returned}\n"
        self.refused(write(tmp_path, body), "Mine", *words)

    @pytest.mark.parametrize(
        ("body", "word"),
        [
            ("    def viscosity(self, shear_rate, p):\n        return p.mu[0, 0] * shear_rate[:2]\n", "viscosity"),
            ("    def memory(self, p):\n        return [1]\n", "tuple of MemoryVariable"),
            ("    def memory(self, p):\n        return (MemoryVariable(0.0),)\n", "must be positive"),
            ("    def memory(self, p):\n        return (MemoryVariable(p.mu[:, 0]),)\n", "shape (3,)"),
            ("    def memory(self, p):\n        return (MemoryVariable(1.0, stiffness=p.mu[:, 0]),)\n", "stiffness"),
            (
                "    def memory(self, p):\n        return (MemoryVariable(1.0, convection=-p.mu),)\n",
                "convection of memory variable 1: float64 of shape (3, 1), not a number",
            ),
            (
                "    def viscosity(self, shear_rate, p):\n        return -p.mu + 0 * shear_rate\n",
                "viscosity(shear_rate, p): returned -0.1 at the example values; it cannot be negative",
            ),
            (
                "    def strained_viscosity(self, stretch, p):\n        return p.mu * (1 - stretch)\n",
                "strained_viscosity(stretch, p): returned -0.2 at the example values; it cannot be negative",
            ),
            ("    parameters = (MU, MU)\n", "two parameters are called 'mu'"),
            ("    parameters = ()\n", "parameters is empty"),
            ("    parameters = (Parameter('E', 'kPa'), MU)\n", "parameter E is declared in kPa"),
            ("    parameters = [MU]\n", "must be a tuple"),
            ("    parameters = (Parameter('R0', 'm'),)\n", "'R0' is taken"),
            ("    def __init__(self, grade):\n        pass\n", "without arguments"),
        ],
    )
    def test_declaration_that_fails(self, tmp_path, body, word):
        self.refused(write(tmp_path, "class Mine(Liquid):\n" + body), "mine.py:Mine", word)

    def test_in_yaml_the_fault_has_its_place(self, tmp_path):
        config = (Path(__file__).parents[2] / "configs" / "quickstart.yaml").read_text()
        assert "law:" in config
        lines = ["  law: ./nowhere.py:Law" if line.strip().startswith("law:") else line for line in config.splitlines()]
        path = tmp_path / "case.yaml"
        path.write_text("\n".join(lines))
        number = 1 + next(i for i, line in enumerate(lines) if "nowhere" in line)
        with pytest.raises(ConfigError, match=rf"case\.yaml:{number}:\d+: model\.law: .*nowhere\.py: no such file"):
            load_config(path)


class TestWorkers:
    def test_spawned_worker_gives_the_same_bits(self, yeoh):
        model = BubbleModel(law=get_law(f"{yeoh}:Yeoh"))
        x = model.initial_state(VALUES)
        call = methodcaller("step", x, 0.0, 12e-6)
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            there = pool.submit(call, model).result(timeout=600)
        np.testing.assert_array_equal(there, call(model))

    def test_reference_and_not_code_is_sent(self, yeoh):
        law = get_law(f"{yeoh}:Yeoh")
        sent = pickle.dumps(law)
        assert bytes(yeoh).hex().encode() in sent
        assert b"strain_energy_rate" not in sent
        assert type(pickle.loads(sent)) is type(law)

    def test_a_file_that_changed_meanwhile_is_refused(self, yeoh):
        law = get_law(f"{yeoh}:Yeoh")
        sent = pickle.dumps(law)
        del sys.modules[type(law).__module__]  # as in a process that has not loaded it
        yeoh.write_text(YEOH + "\n# edited\n")
        with pytest.raises(ConfigError, match=r"yeoh\.py: the file has changed"):
            pickle.loads(sent)
        yeoh.unlink()
        with pytest.raises(ConfigError, match="no such file"):
            pickle.loads(sent)

    def test_built_in_laws_travel_too(self):
        assert pickle.loads(pickle.dumps(get_law("oldroyd-b"))).name == "oldroyd-b"


class TestCommand:
    def run(self, *arguments):
        return CliRunner().invoke(main, ["laws", *arguments])

    def test_list(self):
        done = self.run()
        assert done.exit_code == 0, done.output
        for text in ("quadratic-kelvin-voigt: quadratic-law", "oldroyd-b", "relaxation_time", "Pa s"):
            assert text in done.output

    def test_one_law_with_its_formula(self, yeoh):
        done = self.run(f"{yeoh}:Yeoh")
        assert done.exit_code == 0
        assert r"\tfrac G2" in done.output

    def test_check_passes(self, yeoh):
        done = self.run("--check", f"{yeoh}:Yeoh")
        assert done.exit_code == 0, done.output
        assert "FAIL" not in done.output
        assert "Yeoh: 9 of 9 checks pass" in done.output

    def test_check_fails_and_says_where(self, yeoh):
        yeoh.write_text(YEOH.replace("return 2 *", "return -2 *"))
        done = self.run("--check", f"{yeoh}:Yeoh")
        assert done.exit_code == 1
        assert "FAIL  The elastic stress opposes the strain" in done.output
        assert "at λ = " in done.output
        assert "Yeoh: 1 of 9 checks fail" in done.output

    def test_a_factor_shows_at_small_strain_and_against_the_parent(self, yeoh):
        told = "At small strain: shear modulus {} Pa, viscosity 0.1 Pa s (G = 5e+03, "
        alone = "No parent law is declared (limits): a wrong factor or unit shows in the line above alone"
        assert told.format(5000) in self.run("--check", f"{yeoh}:Yeoh").output
        twice = YEOH.replace("return 2 *", "return 4 *")
        yeoh.write_text(twice)
        done = self.run("--check", f"{yeoh}:Yeoh")
        assert (done.exit_code, told.format("1e+04") in done.output, alone in done.output) == (0, True, True)
        yeoh.write_text(limited(twice, "alpha"))
        done = self.run("--check", f"{yeoh}:Yeoh")
        assert (done.exit_code, told.format("1e+04") in done.output, alone in done.output) == (1, True, False)
        assert "differs from neo-hookean-kelvin-voigt" in done.output
        yeoh.write_text(limited(YEOH, "alpha"))
        assert self.run("--check", f"{yeoh}:Yeoh").exit_code == 0

    def test_a_limit_that_names_no_parameter_fails(self, yeoh):
        yeoh.write_text(limited(YEOH, "alfa"))
        done = self.run("--check", f"{yeoh}:Yeoh")
        assert "limits: 'alfa' is not a parameter of the law; did you mean 'alpha'?" in done.output

    def test_a_limit_that_leaves_out_a_parameter_of_the_parent_alone_names_it(self, tmp_path):
        """A law with a viscosity of its own has no mu, its parent has: unless that is 0, it is not the parent."""
        body = r'''
class Mine(NeoHookeanKelvinVoigt):
    r"""$W$, with a viscosity of its own."""
    title = "mine"
    parameters = (G, MU_0)
    limits = ((NeoHookeanKelvinVoigt, {"mu_0": 0.0}),)

    def viscosity(self, shear_rate, p):
        return p.mu_0 / (1 + 1e-6 * shear_rate)
'''
        done = self.run("--check", write(tmp_path, body))
        assert done.exit_code == 1
        assert "; the parent was run at its own mu = 0.1, which the values do not give" in done.output
        done = self.run("--check", write(tmp_path, body.replace('"mu_0": 0.0', '"mu_0": 0.0, "mu": 0.0')))
        assert done.exit_code == 0, done.output

    def test_unknown_law(self):
        assert self.run("--check", "nowhere.py:Law").exit_code == 2
