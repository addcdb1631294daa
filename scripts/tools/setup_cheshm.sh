#!/bin/sh
# Makes the environment of the extractors `pure`, `else`, `excuse` and `swirski`, for bench-extractors.
#
#     setup_cheshm.sh [--force]
#
# They are detectors in cheshm. Its own code and Swirski's detector have the MIT licence; PuRe, ElSe and ExCuSe may only
# be used for non-commercial purposes, and their authors ask to be cited (LICENSE files beside the modules).
set -eu

name=cheshm version=2.5.0 module=cheshm.pupil_detectors
. "$(dirname -- "$(readlink -f "$0" 2>/dev/null || printf %s "$0")")/_detector.sh"
