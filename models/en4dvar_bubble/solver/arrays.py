"""The arrays that the compiled solver works on, in named groups.

n is the number of unknowns, N that of the members. Arrays that end in :data:`~lanes.WIDTH` hold one column per lane.
"""

from typing import Any, NamedTuple

import numpy as np

from en4dvar.model.state import Array

IntArray = np.ndarray[Any, np.dtype[np.int64]]


class Members(NamedTuple):
    """What is integrated. Members are taken in ``order`` (N,), number ``counter`` (1,) of it is the next. Threads that
    integrate the same arrays at once share the members; which of them integrates one makes no difference to it.
    """

    counter: IntArray
    order: IntArray
    initial: Array  # (N, n) states at ``start``
    parameters: Array  # (N, rows), see :mod:`rows`
    start: Array  # (N,) µs
    times: Array  # (N, K) output times, increasing, µs
    samples: Array  # (N, nodes) of J_e, tabulated when a member's turn comes; or (0, nodes)
    factor: float  # of the samples
    tables: Array  # (N, cells, 8) of J_e where there are no samples; of sharp laws with halved cells behind


class Dims(NamedTuple):
    """Numbers of unknowns, and which equations: those of the general ones by ``radial``, and by ``shear``
    and ``strain``: what the viscosity depends on. ``kinetic``: 1 where vapour crosses the wall at a finite rate.
    """

    gas: int
    vapour: int
    medium: int
    wall: int
    kinetic: int
    memory: int
    radial: int
    shear: int
    strain: int


class Equations(NamedTuple):
    """What the equations read that is the same for all members.

    ``nodes`` is None for the equations with every option; for the paper's, a zero per temperature node. Only its length
    counts. That of a tuple belongs to its type: the compiler knows it and unrolls; an array serves any length. With a
    tuple, ``size`` has a zero per unknown, and the matrix is one dense block; otherwise it is None, and the matrix is
    kept in tiles.
    """

    nodes: Any
    size: Any
    dims: Dims
    gas: Array  # collocation: gas+1 rows of d/dy (the last is the wall), gas of the Laplacian, radii, averaging weights
    elastic_span: Array  # of the tables against ln λ: first, last, cells per unit, cells, times halved at most
    driving: Array  # table of the far-field pressure over its amplitude; of members of their own shape, one each
    driving_span: Array
    reading: int  # when the driving is read, see :mod:`rows`
    # Of the general equations, otherwise None:
    medium: Any  # like ``gas``: medium+1 rows of d/dx, medium of the Laplacian, x − x⁻², x⁻⁶
    memory: Any  # tables of the memory variables
    viscous: Any  # tables of ν against ln |V|
    viscous_span: Any
    # Of a matrix in tiles, otherwise None, see :mod:`tiles`:
    where: Any
    places: Any


class Control(NamedTuple):
    """How steps are chosen and when a member has failed."""

    breaks: Array  # increasing instants (µs, of the driving's table) that no step straddles
    tolerances: Array  # (2, n) absolute and relative
    first_step: float
    longest_driven: float  # longest step while the driving acts, µs of its table
    step_limit: float
    mach_limit: float
    seconds: float  # of wall clock per member, but for those that the process was suspended
    hottest_wall: float  # τ of the wall above which a breakdown is put down to it
    valid_mach: float  # of the wall: since when it is exceeded is recorded


class Output(NamedTuple):
    """``states`` (N, K, n) with NaN where not reached, ``status`` (N,), ``record`` (N, RECORD)."""

    states: Array
    status: IntArray
    record: Array


class Scratch(NamedTuple):
    """What one thread works on: ``block`` (rows, WIDTH) of zeros, where the rows of :class:`Workspace` and
    :class:`Lanes` end ``edges`` (26,), ``marks`` (4, WIDTH) of integers, ``turn`` (6,), ``elastic`` (WIDTH, cells, 8).
    Made by NumPy: a kernel without allocation is compiled faster.
    """

    block: Array
    edges: IntArray
    marks: IntArray
    turn: IntArray
    elastic: Array


class Shared(NamedTuple):
    """What does not depend on the kind of equations, for what is done between two steps."""

    members: Members
    control: Control
    out: Output
    scratch: Scratch
    dims: Dims
    driving_span: Array


class Loaded(NamedTuple):
    """What the equations read of the members in the lanes."""

    par: Array  # (rows, WIDTH)
    elastic: Array  # (WIDTH, cells, 8) of J_e: small enough for the cache


class Lanes(NamedTuple):
    """The members being integrated, each with its own time and step."""

    y: Array
    t: Array
    h: Array
    loaded: Loaded
    member: IntArray  # which one; −1 where a lane is idle
    began: IntArray  # when it was taken, seconds
    observed: IntArray  # output times written
    next_break: IntArray
    proposed: Array  # the step before it was cut at a break
    last_h: Array  # the last accepted step; negative before there is one
    last_root: Array  # the fifth root of its error
    rejected: Any  # whether the last attempt was


class Workspace(NamedTuple):
    """Scratch of a step, and what it leaves: the stages ``k``, ``y_new``; ``norm`` (3, WIDTH) of the error, its fifth
    root, wall Mach number. From ``border`` on it is that of the general equations, whose matrix is in ``tiles`` only.
    """

    work: Array
    f: Array
    jac: Array
    dt: Array
    k: Array
    stage: Array
    y_new: Array
    t_stage: Array
    norm: Array
    dense: Array
    tiles: Array  # the matrix in tiles; a right-hand side and its solution
    extended: Array
    border: Array  # unknowns of the border and their rates; what the fields read of it
    border_f: Array
    shared: Array
    moved_f: Array  # the last two where an unknown of the border is moved
    moved: Array
