"""A program for tests: python curve.py WHAT INPUT OUTPUT; y = a + b cos(t + 1/3), as toys.Linear."""

import json
import math
import os
import sys
import time
from pathlib import Path

what, source, target = sys.argv[1:4]
given = json.loads(Path(source).read_text(encoding="utf-8"))
values = [given["a"] + given["b"] * math.cos(t + 1 / 3) for t in given["times"]]
if what == "fails" and given["a"] > 0:
    sys.exit("a line before\nno convergence")
if what == "hangs":
    os.system("sleep 60 & sleep 60")
if what == "crashes":
    os.abort()
if what == "once":  # fails until its file is there
    flag = Path(os.environ["FLAG"])
    if not flag.exists():
        flag.touch()
        time.sleep(0)
        sys.exit(7)
if what == "nothing":
    sys.exit()
if what == "garbage":
    values = ["n/a" for _ in values]
if what == "comma":
    values = ["1,5" for _ in values]
if what == "gaps" and int(1e7 * given["a"]) % 4 == 0:
    values[4] = "n/a"
if what in ("fortran", "bare"):
    values = [f"{y:.16E}".replace("E", "D") for y in values]
if what == "short":
    values = values[1:]
rows = "".join(f"{t}\t{y}\n" for t, y in zip(given["times"], values, strict=False))
rows += "ended well\t\n" if what == "footer" else ""
marked = "utf-8-sig" if what == "marked" else "utf-8"
Path(target).write_text(rows if what == "bare" else "t\ty\n" + rows, encoding=marked)
Path("out.json").write_text(json.dumps({"run": {"t": given["times"], "y": values}}), encoding="utf-8")
print("".join(f"y = {y}\n" for y in values))
