"""Packs the full records of runs for a release: ``python -m docs.tools.archive docs/results``.

The tables of runs beside the pages hold what the pages say; the archive holds all files of all runs
as they were written. The same files make the same archive, whenever and wherever it is made:
members are sorted, and have neither owner nor time. Beside FILE.tar.xz stands FILE.tar.xz.sha256.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import lzma
import subprocess
import tarfile
from collections.abc import Mapping
from pathlib import Path

from torchrl_tit.files import write_bytes_atomic, write_text_atomic


def files_of_folder(folder: Path) -> dict[str, bytes]:
    """Reads all files of a folder, by their paths."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.as_posix(): path.read_bytes() for path in paths}


def files_of_commit(commit: str, folder: Path) -> dict[str, bytes]:
    """Reads all files of a folder of the repository as they were at a commit, by their paths."""
    command = ["git", "archive", "--format=tar", commit, "--", folder.as_posix()]
    content = subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout
    with tarfile.open(fileobj=io.BytesIO(content)) as tar:
        found = {member.name: tar.extractfile(member) for member in tar}
    return {name: file.read() for name, file in found.items() if file is not None}


def pack(files: Mapping[str, bytes]) -> bytes:
    """Makes a tar of files, the same one of the same files."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name in sorted(files):
            member = tarfile.TarInfo(name)
            member.size = len(files[name])
            tar.addfile(member, io.BytesIO(files[name]))
    return buffer.getvalue()


def main(arguments: list[str] | None = None) -> None:
    """Writes the archive and its SHA-256, and prints those of the archive and of the tar in it."""
    parser = argparse.ArgumentParser("python -m docs.tools.archive")
    parser.add_argument("folder", type=Path, help="folder of runs")
    parser.add_argument("--commit", help="take the folder as it was at this commit")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the .tar.xz file")
    options = parser.parse_args(arguments)
    if options.out.suffixes[-2:] != [".tar", ".xz"]:
        parser.error(f"--out {options.out} must end in .tar.xz")
    if options.commit:
        files = files_of_commit(options.commit, options.folder)
    else:
        files = files_of_folder(options.folder)
    tar = pack(files)
    archive = lzma.compress(tar, preset=9)
    digest = hashlib.sha256(archive).hexdigest()
    write_bytes_atomic(options.out, archive)
    write_text_atomic(options.out.with_suffix(".xz.sha256"), f"{digest}  {options.out.name}\n")
    print(f"{len(files)} files, {len(archive) / 1e6:.1f} MB")
    print(f"{digest}  {options.out.name}")
    print(f"{hashlib.sha256(tar).hexdigest()}  {options.out.stem}")


if __name__ == "__main__":
    main()
