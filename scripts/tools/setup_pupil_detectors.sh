#!/bin/sh
# Makes the environment of the extractor `pupil-detectors` (Pupil Labs' 2D detector, LGPL), for bench-extractors.
#
#     setup_pupil_detectors.sh [--force]
#
# The environment is separate because the package needs the full opencv-python, which would break the headless one
# that eyerender uses. It takes about 350 MB; _detector.sh says where.
set -eu

name=pupil-detectors version=2.0.2 module=pupil_detectors
. "$(dirname -- "$(readlink -f "$0" 2>/dev/null || printf %s "$0")")/_detector.sh"
