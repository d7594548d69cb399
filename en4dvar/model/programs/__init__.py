"""Programs of any language as forward models: a command, files with the parameters filled in, outputs that are read.

``template`` (parameters into files), ``outputs`` (numbers out of files), ``pest`` (the same in the languages of PEST),
``settings`` (a ``model: {command: …}`` section), ``model`` (and one run in its scratch directory).
"""
