"""Movies of bubbles: from frames to radii with errors (``en4dvar track``), and from radii to frames (the renderer).

It knows images and circles and nothing of a bubble's dynamics; the renderer takes R(t) as arrays (``en4dvar simulate
--movie``). From the ground up: ``frames``, ``kernels``, ``outline``, ``fitting``, ``background``, ``uncertainty``,
``flashes``, ``candidates``, ``following``, ``choice``, ``tracking``, ``table``, ``page``, ``scene``, ``filming``,
``commands``. Reading and writing movies needs the extra ``movie``.
"""
