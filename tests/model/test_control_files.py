"""A control file of PEST becomes an estimate: its parameters, observations and weights."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

import en4dvar
from en4dvar.model.programs.control import from_pest
from en4dvar.model.programs.model import CommandModel, CommandSettings
from en4dvar.plumbing.errors import En4dvarError

PUBLIC = Path(__file__).parents[2].parent / "shared" / "reference" / "pest"

CONTROL = f"""pcf
* control data
restart estimation
3 4 1 0 1
1 1 single point
* parameter groups
pg relative 0.01 0.0 switch 2.0 parabolic
* parameter data
A log factor 1.0 0.1 10.0 pg 1.0 0.0 1
b none relative 0.0 -4.0 4.0 pg 1.0 0.0 1
c fixed factor 2.0 1.0 3.0 pg 1.0 0.0 1
* observation groups
og
* observation data
h1 3.5 10.0 og
h2 4.5 10.0 og
bad 99.0 0.0 og
h3 5.5 5.0 og
* model command line
{sys.executable} -S line.py
* model input/output
line.tpl run/line.in
line.ins line.out
"""
PROGRAM = """
a, b, c = (float(word) for word in open("run/line.in"))
open("line.out", "w").write("".join(f"{c + a * t + b} \\n" for t in (1, 2, 3, 3)))
"""


@pytest.fixture
def control(tmp_path):
    (tmp_path / "line.pst").write_text(CONTROL)
    (tmp_path / "line.tpl").write_text("ptf ~\n~        a           ~\n~      b             ~\n~ c  ~\n")
    (tmp_path / "line.ins").write_text("pif @\nl1 !h1!\nl1 !h2!\nl1 !h3!\nl1 !bad!\n")
    (tmp_path / "line.py").write_text(PROGRAM)
    return tmp_path / "line.pst"


def test_a_control_file_says_what_to_estimate_from_what(control):
    found = from_pest(control, ["line.py"])
    assert found["priors"] == {
        "a": {"prior": "lognormal", "median": 1.0, "log_std": math.log(100) / 4, "lower": 0.1, "upper": 10.0},
        "b": {"prior": "normal", "mean": 0.0, "std": 2.0, "lower": -4.0, "upper": 4.0},
        "c": 2.0,
    }
    np.testing.assert_array_equal(found["data"]["observations"], [3.5, 4.5, 5.5])
    np.testing.assert_allclose(found["error"], [0.1, 0.1, 0.2])
    result = en4dvar.estimate(**found, progress=False, assimilation={"members": 8})
    assert result.posterior["a"].mean() == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose(
        result.dataset("posterior_predictive")["observations"].mean(("chain", "draw")), [3.5, 4.5, 5.5], atol=0.1
    )


@pytest.mark.slow
def test_several_commands_run_in_order(control):
    """As PEST++ does: the second command turns what the first one writes; without it, or before it, nothing is read."""
    turn = "import sys; print(open('raw.out').read().replace('x', ''), end='', file=open('line.out', 'w'))"
    (control.parent / "turn.py").write_text(turn)
    (control.parent / "line.py").write_text(PROGRAM.replace('"line.out"', '"raw.out"').replace('f"{c', 'f"x{c'))
    one, two = f"{sys.executable} -S line.py\n", f"{sys.executable} -S turn.py\n"
    text = control.read_text()
    control.write_text(text.replace(one, one + two))
    result = en4dvar.estimate(**from_pest(control, ["line.py", "turn.py"]), progress=False, assimilation={"members": 8})
    assert result.posterior["a"].mean() == pytest.approx(1.0, abs=0.15)
    control.write_text(text.replace(one, two + one))
    with pytest.raises(En4dvarError, match=r"raw\.out"):
        en4dvar.estimate(**from_pest(control, ["line.py", "turn.py"]), progress=False, assimilation={"members": 8})


@pytest.mark.slow
def test_groups_of_inequalities_are_bounds(control):
    """h1 = a + b + 2 is 3.5, h2 = 2 a + b + 2 at most 4.2, far below 4.5; h3 = 3 a + b + 2 at least 4.4."""
    text = control.read_text().replace("h2 4.5 10.0 og", "h2 4.2 10.0 less_h").replace("h3 5.5 5.0 og", "h3 4.4 50 <@h")
    control.write_text(text.replace("h1 3.5 10.0", "h1 3.5 100.0").replace("h2 4.2 10.0", "h2 4.2 100.0"))
    found = from_pest(control, ["line.py"])
    np.testing.assert_array_equal(found["error"]["at_most"], [0, 1, 0])
    np.testing.assert_array_equal(found["error"]["at_least"], [0, 0, 1])
    np.testing.assert_allclose(found["error"]["observations_std"], [0.01, 0.01, 0.02])
    result = en4dvar.estimate(**found, progress=False, assimilation={"members": 48})
    h1, h2, h3 = result.dataset("posterior_predictive")["observations"].values.reshape(-1, 3).T
    assert np.abs(h1 - 3.5).mean() < 0.02
    assert h2.max() < 4.25
    assert h3.min() > 4.3
    assert h2.std() > 0.03  # a in 0.45 to 0.7


def test_the_signs_of_a_group_are_those_of_pestpp_and_pyemu(control):
    """What is penalised stands first: ``>@`` what is greater, an upper bound, and ``<@`` what is less."""
    control.write_text(control.read_text().replace("h2 4.5 10.0 og", "h2 4.5 10.0 >@h"))
    assert list(from_pest(control)["error"]) == ["observations_std", "at_most"]
    control.write_text(control.read_text().replace(">@h", "<@h"))
    assert list(from_pest(control)["error"]) == ["observations_std", "at_least"]


@pytest.mark.slow
def test_a_range_is_two_bounds(control):
    """h1 = a + b + 2 is 3.5; h2 = 2 a + b + 2 lies in 3.9 to 4.2, so that a lies in 0.4 to 0.7."""
    table = (
        "obsnme,obsval,weight,obgnme,greater_than,less_than\nh1,3.5,500,og,,\nh2,4,500,og,3.9,4.2\nh3,5.5,500,og,,9\n"
    )
    own = control.with_name("range.pst")
    begin, end = CONTROL.split("* observation data\n")
    end = end[end.index("* model command line") :]
    own.write_text(f"{begin}* observation data external\nobs.csv\n{end}")
    control.with_name("obs.csv").write_text(table)
    found = from_pest(own, ["line.py"])
    assert found["model"]["outputs"]["observations"]["observations"] == ["h1", "h2", "h2", "h3"]
    np.testing.assert_array_equal(found["data"]["observations"], [3.5, 4.2, 3.9, 9.0])
    np.testing.assert_array_equal(found["error"]["at_most"], [0, 1, 0, 1])
    np.testing.assert_array_equal(found["error"]["at_least"], [0, 0, 1, 0])
    result = en4dvar.estimate(**found, progress=False, assimilation={"members": 48})
    a = result.posterior["a"].values
    assert 0.38 < a.min() < 0.5
    assert 0.6 < a.max() < 0.72
    control.with_name("obs.csv").write_text(table.replace("4.2", "3.8"))
    with pytest.raises(en4dvar.ConfigError, match=r"obs.csv:3: greater_than of h2 is not below its less_than"):
        from_pest(own)


RICH = """pcf
* control data
restart estimation   # a comment
4 5 1 1 1
2 2 single point
* parameter data
hk:1-a log factor 2.0 0.5 10.0 pg -1.0 10.0 1
b none relative 0.0 -4.0 4.0 pg 2.5 0.0 1
t tied factor 3.0 0.0 0.0 pg 1.0 0.0 1
c fixed factor 2.0 1.0 3.0 pg 1.0 0.0 1
t hk:1-a
* observation data
H1 3.5 10.0 og
h2 4.5 4.0 og
unused 1 0.0 l_og
* model command line
cat in/one.dat in/two.dat > out.dat; cp out.dat more.dat
* model input/output
one.tpl in\\one.dat
two.tpl in\\two.dat
out.ins out.dat
more.ins more.dat
* prior information
pi1 1.0 * log(hk:1-a) - 2.5E-1 * b
& = 0.3 5.0 regul
pi2 1.0 * b = 0.3 0.0 regul
++par_sigma_range(6) ies_num_reals(50)
"""
TABLES = {
    "par.csv": "parnme,partrans,parval1,parlbnd,parubnd,scale,offset,partied,standard_deviation,x\n"
    "hk:1-a,log,2,0.5,10,-1,10,,,1\nb,none,0,-4,4,2.5,,,,\nt,tied,3,0,0,,,hk:1-a,,\nc,fixed,2,1,3,,,,,\n",
    "obs.dat": "obsnme obsval weight obgnme\nh1 3.5 10 og\nh2 4.5 4 og\nunused 1 0 missing\n",
    "in.csv": "pest_file,model_file\none.tpl,in/one.dat\ntwo.tpl,in/two.dat\n",
    "out.csv": "pest_file,model_file\nout.ins,out.dat\nmore.ins,more.dat\n",
    "pi.csv": "pilbl,equation,weight,obgnme\npi1,1.0 * log(hk:1-a) - 0.25 * b = 0.3,5.0,r\npi2,1.0*b=0.3,0,r\n",
}
SECOND = """pcf version=2
* control data keyword
pestmode estimation
par_sigma_range 6
* parameter data external
par.csv
* observation data external
obs.dat sep w missing_value missing
* model command line
cat in/one.dat in/two.dat > out.dat; cp out.dat more.dat
* model input external
in.csv
* model output external
out.csv
* prior information external
pi.csv
"""


@pytest.fixture
def rich(tmp_path):
    (tmp_path / "rich.pst").write_text(RICH.replace("\\\\", "\\"))
    (tmp_path / "second.pst").write_text(SECOND)
    for name, text in TABLES.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "one.tpl").write_text("ptf ~\n~   HK:1-a                ~\n~ t                         ~\n")
    (tmp_path / "two.tpl").write_text("ptf #\n#  b                        #\n# c    #\n")
    (tmp_path / "out.ins").write_text("pif @\nl1 !h1!\n")
    (tmp_path / "more.ins").write_text("pif @\nl3 !h2!\n")
    return tmp_path / "rich.pst"


def test_scales_ties_several_files_and_prior_information(rich):
    found = from_pest(rich)
    output = found["model"]["outputs"]["observations"]
    assert found["priors"]["hk_1_a"] == {
        "prior": "lognormal", "median": 2.0, "log_std": pytest.approx(math.log(20) / 6), "lower": 0.5, "upper": 10.0
    }  # fmt: skip
    assert found["priors"]["t"] == {"tied": "hk_1_a", "factor": 1.5}
    assert found["model"]["parameters"] == {
        "hk_1_a": {"scale": -1.0, "offset": 10.0},
        "b": {"scale": 2.5},
        "t": {},
        "c": {},
    }
    assert output["combinations"] == [{"log10(hk_1_a)": 1.0, "b": -0.25}]
    np.testing.assert_array_equal(found["data"]["observations"], [3.5, 4.5, 0.3])
    np.testing.assert_allclose(found["error"], [0.1, 0.25, 0.2])
    assert len(from_pest(rich, prior_information=False)["error"]) == 2
    model = CommandModel(CommandSettings.model_validate(found["model"]))
    (path,) = model.trajectories([[2.0, 3.0, 4.0, 5.0]], found["data"]["time"])
    assert path["observations"] == pytest.approx([8.0, 7.5, math.log10(2) - 0.75], rel=1e-12)


def test_version_2_with_external_tables_says_the_same(rich):
    first, second = from_pest(rich), from_pest(rich.with_name("second.pst"))
    for each in (first, second):
        each["data"] = {key: values.tolist() for key, values in each["data"].items()}
        each["error"] = each["error"].tolist()
    assert first == second


def test_one_observation_is_enough_and_bounds_hold(rich):
    """One reading that asks for hk:1-a = 14, above its upper bound of 10."""
    text = RICH.replace("\\\\", "/").replace("h2 4.5 4.0", "h2 4.5 0.0").replace("H1 3.5 10.0", "h1 -4.0 2.0")
    rich.write_text(text)
    asked = from_pest(rich, prior_information=False)
    result = en4dvar.estimate(**asked, progress=False, assimilation={"members": 12})
    drawn = result.posterior["hk_1_a"].values
    assert np.median(drawn) > 9
    assert drawn.max() < 10


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("restart estimation", "restart regularisation", "prior_information=False leaves it out"),
        ("restart estimation", "restart pareto", "mode pareto is not known here"),
        ("2.0 0.5 10.0 pg -1.0 10.0 1", "2.0 0.5 10.0 pg -1.0 10.0 2", "hk:1-a has a model command of its own"),
        ("++par", "++parcov(prior.cov) par", "option parcov: "),
        ("++par", "++ies_par_en(prior.jcb) par", "prior.jcb: no such file"),
        ("++par", "++ies_parameter_csv(prior.csv) par", "prior.csv: no such file"),
        ("++par", "++ies_obs_csv(noise.csv) par", "noise.csv: no such file"),
        ("++par", "++ies_obs_restart_csv(r.csv) par", "option ies_obs_restart_csv: an estimate begins at its prior"),
        ("++par", "++ies_no_noise(true) par", "option ies_no_noise: errors are drawn here"),
        ("++par", "++obscov(noise.cov) par", "option obscov"),
        (
            "* observation data",
            "* observation groups\nog og.cov\nregul none.cov\n* observation data",
            "group og has a covariance, og.cov",
        ),
        ("2.0 0.5 10.0 pg -1.0", "2.0 0.5 10.0 pg 0.0", "the scale of hk:1-a is 0"),
        ("2.0 0.5 10.0", "20 0.5 10.0", "parval1 of hk:1-a is 20, outside of its bounds 0.5 and 10"),
        ("2.0 0.5 10.0", "2.0 0.0 10.0", "hk:1-a is log, but its lower bound 0 is not above 0"),
        ("t hk:1-a\n", "", "t is tied to no parameter that is estimated or fixed"),
        ("b none", "hk-1:a none", "hk:1-a and hk-1:a are both 'hk_1_a' here"),
        ("1.0 * log(hk:1-a)", "1.0 * log(hk:1-b)", "prior information on hk:1-b, which is no parameter"),
        ("1.0 * log(hk:1-a)", "1.0 ^ log(hk:1-a)", "is no equation of prior information"),
        ("in\\two.dat", "..\\two.dat", "lies outside of the folder that the model runs in"),
        ("* prior information", "* prior beliefs", "no section of a control file is called 'prior beliefs'"),
        ("4.5 4.0 og", "4.5 -4.0 og", "the weight -4 is negative"),
    ],
)
def test_what_would_change_the_estimate_is_refused_by_name(rich, old, new, words):
    text = RICH.replace("\\\\", "\\")
    assert old in text
    rich.write_text(text.replace(old, new))
    with pytest.raises(en4dvar.ConfigError) as caught:
        from_pest(rich)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("table", "old", "new", "words"),
    [
        ("par.csv", "-1,10,,,1\n", "-1,10,,,\n", None),
        ("par.csv", ",standard_deviation", ",mean", None),
        ("par.csv", "b,none,0,-4,4,2.5,,,,", "b,none,0,-4,4,2.5,,,0.75,", None),
        ("par.csv", "b,none,0,-4,4,2.5,,,,", "b,none,0,-4,4,2.5", "par.csv:3: 6 cells, but 10 columns"),
        ("obs.dat", "obgnme\nh1 3.5 10 og", "cycle\nh1 3.5 10 2", "column cycle: the cycles of pestpp-da"),
        ("in.csv", "model_file", "file", "a line of '* model input' holds two names of files"),
    ],
)
def test_external_tables(rich, table, old, new, words):
    assert old in TABLES[table]
    (rich.parent / table).write_text(TABLES[table].replace(old, new))
    if words is None:
        std = from_pest(rich.with_name("second.pst"))["priors"]["b"]["std"]
        assert std == pytest.approx(0.75 if "0.75" in new else 8 / 6)
        return
    with pytest.raises(en4dvar.ConfigError) as caught:
        from_pest(rich.with_name("second.pst"))
    assert words in str(caught.value)


@pytest.mark.skipif(not PUBLIC.is_dir(), reason=f"no {PUBLIC}")
def test_public_control_files_are_read_or_refused_by_name():
    read = 0
    for path in sorted(PUBLIC.rglob("*.pst")):
        try:
            found = from_pest(path, prior_information=False)
        except en4dvar.ConfigError:
            continue
        read += 1
        text = path.read_text().lower()
        lines = text.split("* observation data")[1].split("* model command line")[0].splitlines()
        counted = [words for line in lines if (words := line.split()) and float(words[2]) > 0]
        assert found["model"]["outputs"]["observations"]["observations"] == [words[0] for words in counted]
        error = found["error"]
        std = error["observations_std"] if isinstance(error, dict) else error
        np.testing.assert_allclose(1 / std, [float(words[2]) for words in counted])
    assert read >= 8  # most of the others name templates that are not there


HOSAKI = """\
import math
x, y = (float(line.split(",")[1]) for line in open("par.csv").readlines()[1:])
value = (1 - 8 * x + 7 * x**2 - 7 / 3 * x**3 + x**4 / 4) * y**2 * math.exp(-y)
open("sim.csv", "w").write(f"obsnme,simval\\nsim,{value!r}\\n")
"""  # Hosaki's function, whose minimum of -2.3458 is at (4, 2)
CHEN_OLIVER = """\
x = float(open("par.dat").read())
open("obs.dat", "w").write(f"y {7 / 12 * x**3 - 7 / 2 * x**2 + 8 * x!r}\\n")
"""  # Chen and Oliver (2012), Mathematical Geosciences 44, 1-26, section 4.1


def public(folder, name, script, program):
    """The estimate of the public control file ``name``, with ``program`` as the script that it calls."""
    folder.mkdir()
    for file in (PUBLIC / "pyemu" / "autotest" / name).parent.glob("*.*"):
        (folder / file.name).write_bytes(file.read_bytes())
    path = folder / Path(name).name
    path.write_text(path.read_text().replace("\npython ", f"\n{sys.executable} -S "))
    (folder / script).write_text(program)
    settings = {"members": 12, "what_if": False}
    return en4dvar.estimate(**from_pest(path, files=[script]), progress=False, assimilation=settings).summary()


@pytest.mark.slow
@pytest.mark.skipif(not PUBLIC.is_dir(), reason=f"no {PUBLIC}")
def test_hosaki_ends_at_its_minimum(tmp_path):
    """One reading that is a bound, and two parameters: J is least where the bound and the prior balance."""

    def cost(at):
        x, y = at
        value = (1 - 8 * x + 7 * x**2 - 7 / 3 * x**3 + x**4 / 4) * y**2 * math.exp(-y)
        return 0.5 * np.sum(((at - 2.5) / 1.25) ** 2) + 0.5 * max(0.0, (value + 2.3458115761) / 0.01) ** 2

    least = minimize(cost, [4.0, 2.0], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9})
    found = public(tmp_path / "hosaki", "utils/hosaki_template/pest.pst", "forward_run.py", HOSAKI)
    assert least.x == pytest.approx([4, 2], abs=0.1)
    assert cost(found["centre"].to_numpy()) == pytest.approx(least.fun, abs=0.01)


@pytest.mark.slow
@pytest.mark.skipif(not PUBLIC.is_dir(), reason=f"no {PUBLIC}")
def test_chen_and_oliver_have_the_posterior_of_quadrature(tmp_path):
    """One reading and one parameter: within its bounds in one of the two files, beyond them in the other."""
    name = "smoother/chenoliver/{}chenoliver.pst"
    beyond = public(tmp_path / "beyond", name.format("template/"), "chenoliver.py", CHEN_OLIVER).loc["par"]
    assert beyond["centre"] == pytest.approx(-1, abs=0.001)
    assert "misfit" in beyond["untrusted"].split()
    within = public(tmp_path / "within", name.format(""), "chenoliver.py", CHEN_OLIVER).loc["par"]
    x = np.linspace(5, 7, 20_001)
    weight = np.exp(-0.5 * ((x + 2) / 3.25) ** 2 - 0.5 * (48 - (7 / 12 * x**3 - 7 / 2 * x**2 + 8 * x)) ** 2)
    mean = np.average(x, weights=weight)
    std = np.sqrt(np.average((x - mean) ** 2, weights=weight))
    assert within["centre"] == pytest.approx(mean, abs=0.1 * std)
    assert within["std"] == pytest.approx(std, rel=0.05)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("pcf", "pst", "line.pst: the first line of a control file is pcf"),
        ("b none", "b tied", "line.pst:10: b is tied to no parameter that is estimated or fixed"),
        ("-4.0", "low", "line.pst:10: 'low' where b has a number (parlbnd)"),
        ("99.0 0.0", "99.0", "line.pst:17: 'og' where bad has a number (weight)"),
        ("* model command line", "* command", "line.pst:19: no section of a control file is called 'command'"),
        ("* model command line", "* svd assist", "line.pst: no section '* model command line'"),
        ("line.ins line.out", "", "line.pst: no instruction file"),
        ("line.tpl", "none.tpl", "none.tpl: no such file; the folder holds line.tpl"),
        ("h2 4.5", "H1 4.5", "line.pst:16: observation h1 stands in {0}/line.pst:15, too"),
        ("bad 99.0", "h2 99.0", "line.pst:17: observation h2 stands in {0}/line.pst:16, too"),
        ("A log factor 1.0 0.1", "A log factor 1.0 0", "line.pst:9: a is log, but its lower bound 0 is not above 0"),
    ],
)
def test_what_cannot_be_read_is_told_with_its_line(control, old, new, words):
    control.write_text(CONTROL.replace(old, new))
    with pytest.raises(en4dvar.ConfigError) as caught:
        from_pest(control)
    assert str(caught.value).endswith(words.format(control.parent))


def test_a_parameter_that_is_estimated_is_in_a_template(control):
    """What is fixed need not be; nor what has its place in what is tied to it."""
    template = control.with_name("line.tpl")
    template.write_text("ptf ~\n~        a           ~\n")
    with pytest.raises(en4dvar.ConfigError, match=r"line\.pst:10: parameter b is in no template$"):
        from_pest(control)
    text = CONTROL.replace("* observation groups", "d tied factor 2.0 1.0 3.0 pg 1.0 0.0 1\nd b\n* observation groups")
    control.write_text(text.replace("b none relative 0.0", "b none relative 1.0"))
    template.write_text("ptf ~\n~        a           ~\n~ d  ~\n")
    assert from_pest(control)["priors"]["d"] == {"tied": "b", "factor": 2.0}


def test_a_byte_order_mark_is_no_text(control):
    plain = from_pest(control, ["line.py"])
    for name in ("line.pst", "line.tpl", "line.ins"):
        path = control.with_name(name)
        path.write_text("\ufeff" + path.read_text(), encoding="utf-8")
    marked = from_pest(control, ["line.py"])
    assert marked["priors"] == plain["priors"]
    model = CommandModel(CommandSettings.model_validate(marked["model"]))
    (path,) = model.trajectories([[1.0, 0.5, 2.0]], marked["data"]["time"])
    assert path["observations"] == pytest.approx([3.5, 4.5, 5.5])


def test_files_are_read_for_each_model(control):
    """As they are when it is made: an edited one counts for the next."""
    template, instructions = control.with_name("line.tpl"), control.with_name("line.ins")
    files = template.read_text(), instructions.read_text()
    models = []
    for changed in (True, False):
        template.write_text(files[0].replace("~      b             ~", "-1") if changed else files[0])
        instructions.write_text(files[1].replace("!h1!\nl1 !h2!", "!h2!\nl1 !h1!") if changed else files[1])
        content = {"command": f"{sys.executable} -S line.py", "templates": {"run/line.in": str(template)}}
        content |= {"files": [str(control.with_name("line.py"))], "parameters": {"a": "1", "b": "1", "c": "1"}}
        content["outputs"] = {"h": {"instructions": {"line.out": str(instructions)}, "observations": ["h1", "h2"]}}
        models.append(CommandModel(CommandSettings.model_validate(content)))
    first, second = (next(iter(model.trajectories([[1.0, 0.5, 2.0]], [1.0, 2.0])))["h"] for model in models)
    assert first == pytest.approx([3.0, 2.0])
    assert second == pytest.approx([3.5, 4.5])
