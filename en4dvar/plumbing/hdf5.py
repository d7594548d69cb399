"""HDF5 files that are all there: no data of theirs lies in another file, no link leads into one.

A variable of netCDF may be kept in any file of the machine (external storage, virtual data sets), and a group may be
one of another file: whoever reads and hands on such a file hands on what it names. The netCDF library neither tells nor
refuses, so the links and data sets are looked through first, by h5py.
"""

from pathlib import Path

from en4dvar.plumbing.errors import retold

MOST_OBJECTS = 100_000
DEEPEST = 30


class ForeignDataError(ValueError):
    """Something of the file lies in another one."""


def require_whole(path: Path) -> None:
    """Raises :class:`ForeignDataError` where something of an HDF5 file lies in another one; files that are none pass.

    Raises :class:`OSError`, :class:`RuntimeError` where it is damaged.
    """
    import h5py
    from h5py import h5d, h5g, h5l, h5o

    if not h5py.is_hdf5(path):
        return
    objects = 0
    with h5py.File(path, "r") as file, retold((KeyError, TypeError), RuntimeError):
        groups = [(file["/"].id, "", 0)]
        while groups:
            group, above, depth = groups.pop()
            objects += len(group)
            if objects > MOST_OBJECTS or depth > DEEPEST:
                raise ForeignDataError(f"more than {MOST_OBJECTS} objects, or groups {DEEPEST} deep")
            for name in group:
                path_inside, link = f"{above}/{name.decode('utf-8', 'replace')}", group.links.get_info(name).type
                if link == h5l.TYPE_SOFT:
                    continue  # to another name of this file, which is looked at where it stands
                if link != h5l.TYPE_HARD:
                    raise ForeignDataError(f"{path_inside} is a link into another file, which is not opened")
                held = h5o.open(group, name)
                if isinstance(held, h5g.GroupID):
                    groups.append((held, path_inside, depth + 1))
                elif isinstance(held, h5d.DatasetID):
                    how = held.get_create_plist()
                    own = how.get_layout() in (h5d.COMPACT, h5d.CONTIGUOUS, h5d.CHUNKED)
                    if not own or how.get_external_count():
                        raise ForeignDataError(f"the numbers of {path_inside} are in another file, which is not opened")
