"""Load Qt 5 from the wheel PyQt5-Qt5 on a system without OpenGL and GLib.

EnvPool's Procgen draws its frames with Qt into memory. Qt's libraries also ask the system for
libGL, to draw into windows, and for GLib's event loop. Desktops have both, a minimal system or a
container has neither, and the loader then refuses Qt altogether.

Qt finds its libraries first in the folder that it is loaded from. So it is loaded from a folder of
links to the wheel's libraries, with one more link for each library that the system lacks. That
link bears its name and leads to ICU's data, which needs no other library and defines no function.
Functions are then looked up at their first call instead of at once, and EnvPool calls none of the
missing ones.
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
from pathlib import Path

SYSTEM_LIBRARIES = ("libGL.so.1", "libglib-2.0.so.0", "libgthread-2.0.so.0")


def load_headless_qt(library: str | os.PathLike[str]) -> None:
    """Load one of the wheel's libraries without those of `SYSTEM_LIBRARIES` that are missing.

    The system's own libraries are used where they exist. A program that calls a missing function
    all the same is ended by the loader, whose message names the function.

    Args:
        library: path of the library, such as PyQt5/Qt5/lib/libQt5Gui.so.5

    Raises:
        OSError: the system lacks none of them, or another one as well; or it looks up all functions
            at once, as musl does and as LD_BIND_NOW asks for
    """
    library = Path(library).absolute()
    missing = [name for name in SYSTEM_LIBRARIES if not is_in_system(name)]
    stand_ins = list(library.parent.glob("libicudata.so.*"))
    if sys.platform != "linux" or not missing or not stand_ins:
        raise OSError(f"{library}: cannot do without what the system lacks")

    # Qt's worker threads, which convert large images, would run GLib's event loop.
    os.environ["QT_NO_GLIB"] = "1"

    # Once loaded, a library needs neither its link nor the folder.
    with tempfile.TemporaryDirectory(prefix="qt-") as folder:
        for path in library.parent.iterdir():
            Path(folder, path.name).symlink_to(path)
        for name in missing:
            Path(folder, name).symlink_to(stand_ins[0])
        load_lazily(Path(folder, library.name))


def is_in_system(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def load_lazily(library: Path) -> None:
    """Load a library whose functions are looked up when they are first called.

    `ctypes.CDLL` adds RTLD_NOW to every mode, so dlopen is called without it.
    """
    libc = ctypes.CDLL(None)
    libc.dlopen.restype = ctypes.c_void_p
    libc.dlerror.restype = ctypes.c_char_p
    if not libc.dlopen(os.fsencode(library), os.RTLD_LAZY | os.RTLD_GLOBAL):
        raise OSError(os.fsdecode(libc.dlerror()))
