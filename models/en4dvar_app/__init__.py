"""A local page in the browser over the command line: every step is a command that the page shows.

Nothing is held by the server: commands and their output are files below ``.en4dvar_app`` of the folder, and results are
where the commands write them. So a reload, a second window or a killed server loses nothing. From the ground up:
``job``, ``trusted``, ``steps``, ``pictures``, ``server``, ``commands``.
"""
