"""The pictures of docs/app.md, and how fast the page is.

    python benchmarks/app_page.py [FOLDER_OF_PICTURES [WIDTH]]
    python benchmarks/app_page.py MOVIE
    python benchmarks/app_page.py long

A synthetic movie of the quick start's bubble goes through the page in a headless Chromium. Printed are the times to the
address, the page and the first frame, and the frames a second that are shown while an arrow key is held, of 512 × 512
pixels.
With a movie (of the public bubble in polyacrylamide, which is not shipped), printed are the clicks and the seconds from
the first request to the interval of its shear modulus; with ``long``, the frames a second and the memory of the server
for a movie of 10 000 frames (synthetic, 256 × 256, mp4).
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
TRUTH = "parameters={G: 0.42 kPa, alpha: 0.029, mu: 0.086 Pa s, R0: 0.43 um, t_s: 0 us}"
FRAMES = 60
LONG = 10_000


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "en4dvar.cli", *words]


def film(folder: Path) -> None:
    """Movie of 60 instants, 512 × 512."""
    words = ["simulate", str(ROOT / "configs" / "quickstart.yaml"), "--set", TRUTH, "--times", "5.6 us:29.4 us:0.4 us"]
    made = [
        "--movie",
        str(folder / "bubble.tif"),
        "--movie-set",
        "shape=512x512",
        "--movie-set",
        "pixel=1 um",
        "--movie-set",
        "noise=1",
    ]
    subprocess.run(command(*words, *made, "--seed", "5"), check=True, stdout=subprocess.DEVNULL)


def walk(page: Any, address: str, pictures: Path) -> None:
    """Open the page, read the movie, correct a frame, propose a model; the pictures."""
    begun = time.perf_counter()
    page.goto(address)
    print(f"page: {time.perf_counter() - begun:.2f} s")
    page.wait_for_selector("#inspector:not([hidden])")
    print(f"first frame: {time.perf_counter() - begun:.2f} s")
    rate = page.evaluate(
        f"(async () => {{ const t = performance.now(); for (let n = 0; n < {FRAMES}; n++) await go(n);"
        f" return {FRAMES} / (performance.now() - t) * 1000; }})()"
    )
    print(f"scrubbing: {rate:.0f} frames/s")
    page.fill("#exposure", "100 ns")
    page.click("button[data-step=track]")
    page.wait_for_selector("#job-track.done", timeout=300_000)
    page.evaluate("go(20)")
    page.wait_for_timeout(1000)
    picture(page, "#movies", pictures / "app_movie.png")
    page.select_option("#table", "bubble.csv")
    page.wait_for_timeout(1000)
    page.click("button[data-step=init]")
    page.wait_for_selector("#job-init.done", timeout=300_000)
    page.wait_for_timeout(1500)
    page.click("button[data-step=prior]")
    page.wait_for_selector("#job-validate.done img", timeout=300_000)
    page.wait_for_timeout(1000)
    picture(page, "#model", pictures / "app_model.png")
    page.click("button[data-step=run]")
    while "iteration 20" not in page.inner_text("#log"):  # the page's policy forbids scripts that wait in it
        page.wait_for_timeout(50)
    picture(page, "#bands", pictures / "app_live.png")


def clicks_counted(page: Any) -> None:
    """Count the presses of the mouse in ``window.name``, before anything is opened."""
    page.add_init_script("addEventListener('pointerdown', (e) => { if (e.isTrusted) name = +name + 1; }, true)")


def pull(page: Any, *places: tuple[float, float]) -> None:
    """Draw on the frame, from place to place in its pixels."""
    page.locator("#frame").scroll_into_view_if_needed()
    box, scale = page.locator("#frame").bounding_box(), page.evaluate("frame.clientWidth / movie.width")
    for n, (x, y) in enumerate(places):
        page.mouse.move(box["x"] + x * scale, box["y"] + y * scale, steps=3)
        if n == 0:
            page.mouse.down()
    page.mouse.up()


def from_movie_to_interval(page: Any, wait: Callable[[str], None]) -> None:
    """By mouse and keys on an open page: rate, scale bar, a circle drawn in the collapse (frame 28), and three steps.

    ``wait(expression)`` returns once an expression of JavaScript is true.
    """
    wait("!!movie?.picture")
    page.click("#frame-rate")
    page.keyboard.type("270 kHz")
    page.click("input[value=scale]")
    page.click("#length")
    page.keyboard.type("276 um")
    pull(page, (100, 110), (200, 110))
    page.click("input[value=circle]")
    track = page.locator("#number").bounding_box()
    page.locator("#number").click(position={"x": 8 + 0.28 * (track["width"] - 16), "y": track["height"] / 2})
    while (ahead := 28 - page.evaluate("at")) != 0:
        page.keyboard.press("ArrowRight" if ahead > 0 else "ArrowLeft")
    pull(page, (271, 68), (287, 68))
    wait("kept.startsWith('28 ')")
    for step, next_one in (("track", "document.getElementById('table').value"), ("init", "text.value"), ("run", "1")):
        page.click(f"button[data-step={step}]")
        wait(f"!!document.querySelector('#job-{step}.done') && !!{next_one}")


def timed(page: Any, address: str) -> None:
    """Print clicks and seconds, and what the page then says of the shear modulus."""
    clicks_counted(page)
    begun = time.perf_counter()

    def wait(expression: str) -> None:
        while not page.evaluate(expression):
            page.wait_for_timeout(50)

    page.goto(address)
    wait("state !== null")
    from_movie_to_interval(page, wait)
    print(f"{page.evaluate('name')} clicks, {time.perf_counter() - begun:.0f} s")
    print(*(line for line in page.inner_text("#job-run pre").splitlines() if " G " in line), sep="\n")


def film_long(path: Path) -> None:
    """10 000 frames of a disc whose radius swings, with noise (seed 1), as mp4."""
    import av

    rng, (y, x) = np.random.default_rng(1), np.mgrid[:256, :256] - 128
    noise = rng.normal(0, 2, (16, 256, 256))
    with av.open(str(path), "w") as file:
        stream = file.add_stream("mpeg4", rate=30)
        stream.width = stream.height = 256
        stream.bit_rate = 1_500_000
        for n in range(LONG):
            grey = np.where(x**2 + y**2 < (60 + 30 * np.sin(n / 50)) ** 2, 60, 180) + noise[n % 16]
            frame = av.VideoFrame.from_ndarray(grey.clip(0, 255).astype(np.uint8), format="gray")
            file.mux(stream.encode(frame.reformat(format="yuv420p")))
        file.mux(stream.encode())
    print(f"{path.stat().st_size / 1e6:.0f} MB, {LONG} frames")


def scrubbed(page: Any, address: str, process: int) -> None:
    """Print how fast the frames of a long movie are shown, and what its server takes at most."""
    begun = time.perf_counter()
    page.goto(address)
    page.wait_for_selector("#inspector:not([hidden])")
    page.evaluate("go(0)")
    print(f"first frame: {time.perf_counter() - begun:.1f} s")
    for name, first, last in (("begin", 0, 200), ("middle", 5000, 5200), ("back", 5200, 5000), ("end", 9700, 9900)):
        begun = time.perf_counter()
        page.evaluate(f"go({first})")
        jump, step = time.perf_counter() - begun, 1 if last > first else -1
        rate = page.evaluate(
            "(async () => { const t = performance.now();"
            f" for (let n = {first}; n !== {last}; n += {step}) await go(n);"
            f" return {abs(last - first)} / (performance.now() - t) * 1000; }})()"
        )
        print(f"{name}: frame {first} after {jump:.1f} s, then {rate:.0f} frames/s")
    most = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text(encoding="utf-8"))
    assert most is not None
    print(f"memory of the server at most: {int(most[1]) / 1000:.0f} MB")


def picture(page: Any, part: str, path: Path) -> None:
    """A part of the page, at two thirds of its size and in few colours: small files."""
    shot = Image.open(io.BytesIO(page.locator(part).screenshot())).convert("RGB")
    small = shot.resize((2 * shot.width // 3, 2 * shot.height // 3), Image.Resampling.LANCZOS)
    small.quantize(24, dither=Image.Dither.NONE).save(path, optimize=True)


def main(given: str, width: int = 1280) -> None:
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "movies"
        folder.mkdir()
        if given == "long":
            film_long(folder / "long.mp4")
        elif Path(given).is_file():
            shutil.copy(given, folder)
        else:
            film(folder)
        begun = time.perf_counter()
        server = subprocess.Popen(command("app", str(folder), "--no-browser"), stdout=subprocess.PIPE, text=True)
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        print(f"address: {time.perf_counter() - begun:.2f} s after the command")
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": width, "height": 900})
            if given == "long":
                scrubbed(page, address, server.pid)
            elif Path(given).is_file():
                timed(page, address)
            else:
                Path(given).mkdir(parents=True, exist_ok=True)
                walk(page, address, Path(given))
            browser.close()
        server.terminate()


if __name__ == "__main__":
    main(sys.argv[1] if sys.argv[1:] else str(ROOT / "docs" / "assets"), *map(int, sys.argv[2:]))
