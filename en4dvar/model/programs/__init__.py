"""Programs of any language as forward models: a command, files with the parameters filled in, outputs that are read.

``languages`` (of templates and instructions), ``settings`` (a ``model: {command: …}`` section), ``model`` (one run in
its scratch directory, and numbers out of files), ``control_file`` and ``control`` (those of PEST).
"""
