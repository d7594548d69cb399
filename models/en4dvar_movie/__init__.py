"""Movies of bubbles: from frames to radii with errors (``en4dvar track``), and from radii to frames (the renderer).

It knows images and circles and nothing of a bubble's dynamics; the renderer takes R(t) as arrays. From the ground up:
``frames``, ``kernels``, ``outline``, ``locate``, ``background``, ``corrections``, ``uncertainty``, ``tracking``,
``table``, ``page``, ``scene``, ``commands``. Reading and writing movies needs the extra ``movie``.
"""
