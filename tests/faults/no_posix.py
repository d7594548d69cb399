"""Take away what Windows lacks, and refuse what it refuses: to rename or remove a file that this process has open.

As ``sitecustomize`` of every process of a test. ``taskkill`` is a program of Windows; here it is this file.
"""

import os
import signal
import sys
import types

import filelock  # before fcntl goes: on Windows it has locks of the system's own


def _is_open(path):
    """Whether a descriptor of this process is of the file, or of one in the folder."""
    whole = os.path.realpath(path)
    for name in os.listdir("/proc/self/fd"):
        try:
            file = os.readlink(f"/proc/self/fd/{name}")
        except OSError:
            continue
        if file == whole or file.startswith(f"{whole}{os.sep}"):
            return True
    return False


def _refusing(call, count):
    def refused(*paths, **more):
        for path in paths[:count]:
            if not more and os.path.lexists(path) and not os.path.islink(path) and _is_open(path):
                raise PermissionError(13, "The process cannot access the file because it is being used", str(path))
        return call(*paths, **more)

    return refused


def _asking_nothing(wake, unblock):
    """Windows lets the pipe of signals block."""

    def set_wakeup_fd(file, **more):
        if file >= 0:
            unblock(file, False)
        return wake(file, **more)

    return set_wakeup_fd


def _leave_all_to_filelock():
    """The modules of filelock for POSIX, which no Windows loads, keep a module ``os`` in which nothing is missing."""
    whole = types.ModuleType("os")
    vars(whole).update(vars(os))
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] == filelock.__name__ and getattr(module, "os", None) is os:
            module.os = whole


def take_away():
    _leave_all_to_filelock()
    signal.set_wakeup_fd = _asking_nothing(signal.set_wakeup_fd, os.set_blocking)
    sys.modules["fcntl"] = sys.modules["resource"] = None
    for name in ("fork", "forkpty", "killpg", "setsid", "O_NOFOLLOW", "O_NONBLOCK", "pidfd_open", "set_blocking"):
        delattr(os, name) if hasattr(os, name) else None
    for name in ("SIGHUP", "SIGXCPU"):
        delattr(signal, name)
    for name, count in (("replace", 2), ("rename", 2), ("unlink", 1), ("remove", 1), ("rmdir", 1)):
        setattr(os, name, _refusing(getattr(os, name), count))


def taskkill(pid):
    import psutil

    try:
        process = psutil.Process(pid)
        for each in (*process.children(recursive=True), process):
            each.kill()
    except psutil.NoSuchProcess:
        pass


if __name__ == "__main__":
    taskkill(int(sys.argv[-1]))
elif __name__ == "sitecustomize":
    take_away()
