import pytest

import dsar_exporters.drafts
import dsar_render.drafts

packages = pytest.mark.parametrize(
    "replacing",
    [dsar_exporters.drafts.replacing, dsar_render.drafts.replacing],
    ids=["exporters", "render"],
)


@packages
def test_a_finished_draft_replaces_the_file_and_makes_its_folder(replacing, tmp_path):
    path = tmp_path / "new" / "image.exr"
    for contents in ("first", "second"):
        with replacing(path) as draft:
            draft.write_text(contents)
            assert not list(tmp_path.rglob("*.exr")) or path.read_text() == "first"
        assert path.read_text() == contents
    assert list(path.parent.iterdir()) == [path]


@packages
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_draft_leaves_the_old_file_and_nothing_else(replacing, tmp_path, error):
    path = tmp_path / "image.exr"
    path.write_text("old")

    def write_half():
        with replacing(path) as draft:
            draft.write_text("half")
            raise error

    with pytest.raises(error):
        write_half()
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "old"
