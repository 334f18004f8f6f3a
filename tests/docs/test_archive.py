"""The archive of the full records: the same files make the same archive."""

import hashlib
import os
import subprocess
import tarfile

from docs.tools.archive import main


def write(folder, names):
    for name in names:
        path = folder / "docs" / "results" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"of {name}\n")
        os.utime(path, (len(name), len(name)))


def archive(folder, monkeypatch, *options):
    monkeypatch.chdir(folder)
    main(["docs/results", "--out", "runs.tar.xz", *options])
    content = (folder / "runs.tar.xz").read_bytes()
    digest = (folder / "runs.tar.xz.sha256").read_text()
    assert digest == f"{hashlib.sha256(content).hexdigest()}  runs.tar.xz\n"
    return content


def test_the_same_files_make_the_same_archive(tmp_path, monkeypatch, capsys):
    names = ["page/seed-0/recipe.json", "page.md", "page/seed-10/metrics.csv"]
    one, two = tmp_path / "one", tmp_path / "two"
    write(one, names), write(two, names[::-1])
    (two / "docs/results/page.md").chmod(0o700)
    content = archive(one, monkeypatch)
    assert archive(two, monkeypatch) == content
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@example.org"]
    for words in (["init", "-q"], ["add", "docs"], ["commit", "-qm", "Runs"]):
        subprocess.run([*git, *words], cwd=one, check=True)
    (one / "docs/results/page.md").write_text("changed since\n")
    assert archive(one, monkeypatch) != content
    assert archive(one, monkeypatch, "--commit", "HEAD") == content
    with tarfile.open(one / "runs.tar.xz") as tar:
        assert tar.getnames() == [f"docs/results/{name}" for name in sorted(names)]
    assert capsys.readouterr().out.startswith("3 files, ")
