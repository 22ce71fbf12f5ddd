"""A board's flash disk for the interpreter in Node.js: the folder /board as root, errors numbered as on boards.

Run at boot by repl.mjs. Emscripten numbers errors in its own way; MicroPython's tools expect MicroPython's numbers.
With ROM set, the board has flash besides from which code runs: /rom.img, a block device here, read at the next boot.
"""

import os
import sys

import vfs

_ERRNO = {2: 13, 20: 17, 28: 22, 31: 21, 44: 2, 54: 20, 55: 39}


class FlashDisk:
    def __init__(self):
        self._fs = vfs.VfsPosix("/board")

    def open(self, path, mode):
        return self._do("open", _absolute(path), mode)

    def rename(self, old, new):
        return self._do("rename", _absolute(old), _absolute(new))

    def mount(self, readonly, mkfs):
        self._fs.mount(readonly, mkfs)

    def umount(self):
        self._fs.umount()

    def getcwd(self):
        return "/"

    def __getattr__(self, name):
        return lambda path: self._do(name, _absolute(path))

    def _do(self, name, *arguments):
        try:
            return getattr(self._fs, name)(*arguments)
        except OSError as error:
            raise OSError(_ERRNO.get(error.errno, error.errno)) from None


def _absolute(path):
    """Relative paths would start at Emscripten's working folder, outside the disk."""
    return path if path.startswith("/") else "/" + path


disk = FlashDisk()
os.umount("/")
os.mount(disk, "/")
os.chdir("/")  # else it is the ROM file system, where there is one

host = vfs.VfsPosix("/")


class RomPart:
    def ioctl(self, what, argument):
        return {4: 16, 5: 4096}.get(what, 0)  # blocks, bytes of each

    def writeblocks(self, block, data, offset=0):
        with host.open("/rom.img", "rb+") as image:
            image.seek(block * 4096 + offset)
            image.write(data)


class Vfs:
    mount, umount = vfs.mount, vfs.umount

    @staticmethod
    def rom_ioctl(what, *_):
        return RomPart() if what == 2 else 1


if ROM:  # noqa: F821 - set by repl.mjs
    sys.modules["vfs"] = Vfs
