"""Make the thumbnails of the gallery for builds that run no example.

python scripts/tools/make_thumbnails.py [01 02 ...]      (default: all)

Each example runs in its small form, as in its test; its first picture becomes docs/data/thumbnails/NAME.png.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests.test_examples import EXAMPLES, SAVED, small  # noqa: E402

SIZE = (160, 112)  # of sphinx-gallery


def main() -> None:
    """Run the examples, all of them or those whose numbers are given."""
    folder = ROOT / "docs" / "data" / "thumbnails"
    folder.mkdir(exist_ok=True)
    for path in EXAMPLES:
        if sys.argv[1:] and path.name[:2] not in sys.argv[1:]:
            continue
        with tempfile.TemporaryDirectory() as place:
            script = Path(place) / path.name
            script.write_text(small(path.read_text(encoding="utf-8")) + SAVED, encoding="utf-8")
            environment = {**os.environ, "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT), "TMPDIR": place}
            subprocess.run([sys.executable, script.name], cwd=place, env=environment, check=True)
            picture = Image.open(min(Path(place).glob("picture_*.png"))).convert("RGB")
            picture.thumbnail(SIZE)
            whole = Image.new("RGB", SIZE, "white")
            whole.paste(picture, ((SIZE[0] - picture.width) // 2, (SIZE[1] - picture.height) // 2))
            whole.quantize(48).save(folder / f"{path.stem}.png", optimize=True)


if __name__ == "__main__":
    main()
