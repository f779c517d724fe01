"""The controller as it runs on the tablet: Python and numpy alone. This folder is part of every bundle, as `controller/`.

`python -m controller BUNDLE_FOLDER` checks the folder against its test vectors, and with `--run` reads beta amplitudes from standard input.
"""
