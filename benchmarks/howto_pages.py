"""The pictures of the how-to pages: ``python benchmarks/howto_pages.py [FOLDER_OF_PICTURES [NAME …]]``.

Each is what a reader of the page sees: pages of runs, figures, terminals. All data are synthetic but those of the page
on several series (pelts of hares and lynxes); the seeds are those of the configurations and of the commands.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import numpy as np
from pictures import DATA, ROOT, Camera, call, files_of, follow, lines_of, take, typed
from PIL import Image

from en4dvar_bubble import BubbleModel
from en4dvar_bubble.events import events
from en4dvar_bubble.laws.loading import get_law

CONFIGS = ROOT / "configs"


def mat_files(folder: Path, shoot: Camera) -> None:
    """The page of the bubble of the page's file."""
    laser(folder)
    typed(folder, lines_of("mat_files.md", "en4dvar run")[0])
    shoot("runs/laser/report.html", "howto_mat_files", 1000)


def laser(folder: Path) -> None:
    """The files of the page on .mat files, its simulated bubble among them."""
    files_of("mat_files.md", folder)
    typed(folder, lines_of("mat_files.md", "en4dvar simulate")[0])
    typed(folder, f"{sys.executable} to_mat.py")


def run(folder: Path, name: str, *values: str) -> None:
    """A shipped configuration, with keys set."""
    changed = [word for value in values for word in ("--set", value)]
    call(folder, "run", str(CONFIGS / f"{name}.yaml"), *changed, "--out", "run")


def own_data(folder: Path, shoot: Camera) -> None:
    """Readings after the window, predicted."""
    window = "data.window={from: start, to: 16 us}"
    run(folder, "quickstart", window)
    shoot("run/report.html", "howto_own_data", 900, "#d0-withheld")


def impossible_scales(folder: Path, shoot: Camera) -> None:
    """What ``init`` says of radii 1.5 times too large."""
    laser(folder)
    t, radius = np.loadtxt(folder / "laser.csv", delimiter=",", comments="#", skiprows=4).T
    table = np.column_stack([1e6 * t, 1.5 * radius])
    np.savetxt(folder / "film.csv", table, delimiter=",", header="t_us,R_um", comments="", fmt="%.2f")
    line = "en4dvar init --data film.csv"
    shoot.terminal("howto_impossible_scales", [(line, typed(folder, line))])


def priors_and_noise(folder: Path, shoot: Camera) -> None:
    """A prior that excludes the readings."""
    narrow = "parameters.R0={prior: lognormal, median: 0.15 um, log_std: 0.1}"
    call(folder, "validate", str(CONFIGS / "quickstart.yaml"), "--plot", "--set", narrow)
    (picture,) = folder.rglob("*prior*.png")
    shoot.keep(Image.open(picture), "howto_priors")


def several_series(folder: Path, shoot: Camera) -> None:
    """Two series, measured: pelts of hares and lynxes."""
    run(folder, "predator_prey")
    shoot("run/report.html", "howto_several_series", 1000)


def varying_parameters(folder: Path, shoot: Camera) -> None:
    """A viscosity in pieces."""
    run(folder, "laser_varying")
    shoot("run/report.html", "howto_varying", 900, "#d0-varying")


def programs(folder: Path, shoot: Camera) -> None:
    """The page of a run of a program."""
    run(folder, "external_program")
    shoot("run/report.html", "howto_programs", 1000)


def own_model_further(folder: Path, shoot: Camera) -> None:
    """The page of a twin experiment."""
    files_of("own_model_further.md", folder)
    typed(folder, lines_of("own_model_further.md", "en4dvar run")[0])
    shoot("runs/twin/report.html", "howto_twin", 1000)


def cluster(folder: Path, shoot: Camera) -> None:
    """The terminal of a campaign."""
    files_of("cluster.md", folder)
    made = lines_of("cluster.md")[:2]
    for line in made:
        typed(folder, line)
    run = lines_of("cluster.md", "en4dvar run campaign.yaml --workers")[0]
    shoot.terminal("howto_cluster", [(run, typed(folder, run))])


def correlated_priors(folder: Path, shoot: Camera) -> None:
    """Members of prior and posterior whose prior correlates G and mu."""
    stated = "prior_correlation=[{between: [G, mu], correlation: 0.6}]"
    run(folder, "quickstart", stated)
    shoot("run/report.html", "howto_correlated", 900, "#d0-pairs")


def observation_errors(folder: Path, shoot: Camera) -> None:
    """A reading that is 20 um too large, with a robust cost."""
    lines = (CONFIGS / "data" / "agarose_synthetic.csv").read_text(encoding="utf-8").splitlines()
    t, radius, *rest = lines[-8].split(",")
    lines[-8] = ",".join([t, str(float(radius) + 20), *rest])
    (folder / "outlier.csv").write_text("\n".join(lines), encoding="utf-8")
    error = "data.error={radius_std: 1.4 um, robust: huber}"
    data = f"data.path={folder / 'outlier.csv'}"
    run(folder, "quickstart", error, data)
    shoot("run/report.html", "howto_errors", 1000)


def discrepancy(folder: Path, shoot: Camera) -> None:
    """What a law without stiffening misses of a gel that stiffens."""
    each = "G: {M, median: 4 kPa, log_std: 1}, mu: {M, median: 0.1 Pa s, log_std: 1}, R0: {M, median: 1 um, log_std: 1}"
    parameters = f"parameters={{{each.replace('M', 'prior: lognormal')}}}"
    error = "data.error={radius_std: 1.4 um, discrepancy: estimated}"
    run(folder, "quickstart", error, parameters, "model.law=neo-hookean-kelvin-voigt")
    shoot("run/report.html", "howto_discrepancy", 1000, "#d0-residuals")


def fields(folder: Path, shoot: Camera) -> None:
    """Maps of 10 000 cells."""
    run(folder, "diffusion_field")
    shoot("run/report.html", "howto_fields", 900, "#d0-fields", colours=96)


def joint(folder: Path, shoot: Camera) -> None:
    """Laser and acoustic bubbles of one gel."""
    for line in lines_of("joint.md", "en4dvar run configs") + lines_of("joint.md", "en4dvar joint runs/combined"):
        typed(folder, line.replace("configs/", f"{CONFIGS}/"))
    (page,) = folder.glob("runs/joint_*/joint.html")
    shoot(str(page.relative_to(folder)), "howto_joint", 566, "figure")


def population(folder: Path, shoot: Camera) -> None:
    """The median of a gel and its spread."""
    follow("many_bubbles.md", folder)
    typed(folder, "en4dvar population runs/gel --of G --of mu --out all")
    shoot("all/population.html", "howto_population", 1000)


def comparing_gels(folder: Path, shoot: Camera) -> None:
    """Two gels, six bubbles each."""
    files_of("many_bubbles.md", folder)
    make, run = lines_of("many_bubbles.md", "for n")[0], lines_of("many_bubbles.md", "en4dvar run")[0]
    for stiffness in (5, 8):
        gel = f"gel_{stiffness}"
        (folder / gel).mkdir()
        made = make.replace("G=8 kPa", f"G={stiffness} kPa").replace("readings/", f"{gel}/")
        typed(folder, made.replace("--seed $n", f"--seed {stiffness}$n"))
        typed(folder, f"{run} --set data.path={gel} --set name={gel}")
    typed(folder, "en4dvar compare runs/gel_5 runs/gel_8")
    (page,) = folder.rglob("compare.html")
    shoot(str(page.relative_to(folder)), "howto_gels", 560)


def collapse_times(folder: Path, shoot: Camera) -> None:
    """One gel of twelve collapse times with errors, its radii known to half a per cent."""
    rng = np.random.default_rng(1)
    largest, stretch = rng.uniform(150e-6, 390e-6, 12), rng.uniform(5.5, 9, 12)
    model = BubbleModel(law=get_law("neo-hookean-kelvin-voigt"), start="laser", gas="heat", vapour="transport")
    gel = {"G": np.full(12, 8e3), "mu": np.full(12, 0.09), "R_max": largest, "R_eq": largest / stretch}
    read = events(model.integrate(model.initial_states(gel), np.tile([6e-5], (12, 1))))["time"][:, 1]
    table = np.column_stack([largest, stretch, read + 20e-9 * rng.standard_normal(12)])
    table[:, :2] *= np.exp(0.005 * rng.standard_normal((12, 2)))
    np.savetxt(folder / "pool.csv", table, delimiter=",", header="R_max,stretch,collapse", comments="")
    typed(folder, "en4dvar init --data pool.csv --medium water --out pool.yaml")
    typed(folder, "en4dvar run pool.yaml")
    (page,) = folder.rglob("joint.html")
    shoot(str(page.relative_to(folder)), "howto_collapse_times", 900)


def design(folder: Path, shoot: Camera) -> None:
    """The page of planned experiments."""
    call(folder, "design", str(CONFIGS / "laser_design.yaml"), "--out", "plan")
    shoot("plan/design.html", "howto_design", 1085)


def tutorial_library(folder: Path, shoot: Camera) -> None:
    """What ``plot_histograms`` draws in the session of the page."""
    session("tutorial_library.md", "plot_histograms", folder)
    shoot.keep(Image.open(folder / "posterior.png"), "howto_library")


def function_and_arrays(folder: Path, shoot: Camera) -> None:
    """What ``plot`` draws in the session of the page."""
    session("function_and_arrays.md", "coffee.plot()", folder)
    shoot.keep(Image.open(folder / "plot.png"), "howto_function")


def session(page: str, last: str, folder: Path) -> None:
    """Run the blocks of a page of Python up to the one with ``last``; a bare ``.plot()`` is kept."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.S)
    (end,) = (n for n, block in enumerate(blocks) if last in block)
    code = "\n".join(blocks[: end + 1]).replace(".plot()", '.plot().savefig("plot.png", dpi=150)')
    (folder / "session.py").write_text(code, encoding="utf-8")
    typed(folder, f"MPLBACKEND=agg {sys.executable} session.py")


def limits(folder: Path, shoot: Camera) -> None:
    """A result that names a law that no configuration of the reader's has named."""
    files_of("own_constitutive_law.md", folder)
    law = "G: {prior: lognormal, median: 0.5 kPa, log_std: 0.3}, beta: 1e-3, gamma: 0, mu: 0.1 Pa s, R0: 0.5 um"
    data, _ = (CONFIGS / "quickstart.yaml").read_text(encoding="utf-8").split("model:")
    case = (
        data.replace("data/agarose", f"{DATA}/agarose")
        + f"model: {{name: bubble, law: ./yeoh.py:Yeoh}}\nparameters: {{{law}}}\n"
    )
    (folder / "theirs.yaml").write_text(case, encoding="utf-8")
    typed(folder, "en4dvar run theirs.yaml --out runs/theirs --no-report")
    shutil.rmtree(folder / ".state")  # as on another machine
    line = "en4dvar rerun runs/theirs"
    shoot.terminal("howto_limits", [(line, typed(folder, line))])


STEPS = (
    mat_files, own_data, impossible_scales, priors_and_noise, several_series, varying_parameters, programs,
    own_model_further, cluster, correlated_priors, observation_errors, discrepancy, fields, joint, population,
    comparing_gels, collapse_times, design, tutorial_library, function_and_arrays, limits,
)  # fmt: skip

if __name__ == "__main__":
    take(STEPS, sys.argv[1:], width=760, colours=32)
