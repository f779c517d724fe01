"""A controller as a C99 header: no allocation, no library, one call per period.

    betaloop_state state;
    betaloop_start(&state);
    /* every period: */ betaloop_decision d = betaloop_decide(&state, now_ms, sample_or_0);

`float_header` has float32 weights of any size, `fixed_point_header` a small network in whole numbers (`ml/deploy/fixed_point.py`).
`self_test` is a program that checks either against the bundle's test vectors. Names of people, participants and policies reach the C text
through `comment` and `string_literal` alone. They let nothing through that could end a comment or a string.
"""

from __future__ import annotations

import string
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.c_envelope import ENVELOPE, SELF_TEST, TANH, TYPES
from ml.deploy.fixed_point import SCORE_LIMIT, FixedPointNetwork
from ml.deploy.manifest import BundleError, BundleManifest
from ml.deploy.runtime.envelope import FLAG_MA, LARGEST_BETA, REASON_NAMES, SPACING_TOLERANCE, Reason
from ml.deploy.runtime.network import MlpNetwork, Output
from ml.deploy.vectors import Step

_SAFE = set(string.ascii_letters + string.digits + " _.,:;+-()=<>@#%")
_RENDERED_PER_LINE = 8
LIMIT_REASONS = Reason.MINIMUM | Reason.MAXIMUM | Reason.RAMP
INT32_MAX = 2**31 - 1
ALL_REASONS = sum(REASON_NAMES)


def comment(text: str) -> str:
    """Escape text for a C comment: what could end it, start a trigraph or a line splice becomes '_'."""
    return "".join(char if char in _SAFE else "_" for char in text)


def string_literal(text: str) -> str:
    """Write text as a C string: everything but plain letters, digits and a few signs as octal bytes of UTF-8."""
    return '"' + "".join(chr(byte) if chr(byte) in _SAFE and byte < 128 else f"\\{byte:03o}" for byte in text.encode()) + '"'


def float_header(manifest: BundleManifest, network: MlpNetwork) -> str:
    """Write the controller with float32 weights."""
    sizes = [network.window, *(len(b) for _, b in network.layers)]
    parts = [_preamble(manifest, "float32 weights"), "typedef float betaloop_score;\n", TYPES]
    for index, (weights, bias) in enumerate(network.layers):
        # [inputs][outputs]: the inner loop then runs over independent sums, which a compiler may do several at a time
        rows = "},\n    {".join(_floats(column) for column in weights.T)
        parts.append(f"static const float betaloop_weights_{index}[{sizes[index]}][{sizes[index + 1]}] = {{\n    {{{rows}}}}};")
        parts.append(f"static const float betaloop_bias_{index}[{sizes[index + 1]}] = {{{_floats(bias)}}};")
    parts += [
        "",
        "/* z-score of a beta amplitude */",
        "betaloop_linkage float betaloop_score_of(float beta) {",
        f"    return (beta - {_float(network.mean)}) / {_float(network.std)};",
        "}\n",
        TANH,
        "/* Amplitude fraction for a window of z-scores, oldest first. */",
        "betaloop_linkage float betaloop_fraction(const float *scores) {",
        *(f"    float hidden_{index + 1}[{size}];" for index, size in enumerate(sizes[1:])),
        "    int i, j;",
    ]
    for index, size in enumerate(sizes[1:]):
        source = "scores" if index == 0 else f"hidden_{index}"
        target = f"hidden_{index + 1}"
        parts += [
            f"    for (i = 0; i < {size}; ++i) {target}[i] = betaloop_bias_{index}[i];",
            f"    for (j = 0; j < {sizes[index]}; ++j)",
            f"        for (i = 0; i < {size}; ++i) {target}[i] += betaloop_weights_{index}[j][i] * {source}[j];",
        ]
        if index < len(sizes) - 2:
            relu = network.activations[index] == "relu"
            bent = f"{target}[i] < 0.0f ? 0.0f : {target}[i]" if relu else f"betaloop_tanh({target}[i])"
            parts.append(f"    for (i = 0; i < {size}; ++i) {target}[i] = {bent};")
    parts += [*_answer(f"hidden_{len(sizes) - 1}[0]", network.output), "}\n", ENVELOPE]
    return "\n".join(parts)


def fixed_point_header(manifest: BundleManifest, fixed: FixedPointNetwork) -> str:
    """Write the controller in whole numbers."""
    kind = f"int8 weights in {fixed.planes} plane{'s' if fixed.planes > 1 else ''}, guaranteed error of the fraction {fixed.bound:.3g}"
    parts = [_preamble(manifest, kind), "typedef int16_t betaloop_score;\n", TYPES]
    for index, layer in enumerate(fixed.layers):
        for p, plane in enumerate(layer.planes):
            rows = "},\n    {".join(_ints(row) for row in plane)
            parts.append(f"static const int8_t betaloop_plane_{index}_{p}[{plane.shape[0]}][{plane.shape[1]}] = {{\n    {{{rows}}}}};")
        parts.append(f"static const int32_t betaloop_bias_{index}[{layer.bias.size}] = {{{_ints(layer.bias)}}};")
        if layer.multiplier.size:
            parts.append(f"static const int32_t betaloop_multiplier_{index}[{layer.bias.size}] = {{{_ints(layer.multiplier)}}};")
        elif index < len(fixed.layers) - 1:
            parts.append(f"static const float betaloop_unit_{index}[{layer.bias.size}] = {{{_floats(layer.unit)}}};")
    parts += [
        "",
        f"/* z-score of a beta amplitude in steps of 8/32767, cut at {SCORE_LIMIT:g} standard deviations */",
        "betaloop_linkage int16_t betaloop_score_of(float beta) {",
        f"    float score = (beta - {_float(fixed.mean)}) / {_float(fixed.std)};",
        f"    score = (score < {-SCORE_LIMIT:.1f}f ? {-SCORE_LIMIT:.1f}f : score > {SCORE_LIMIT:.1f}f ? {SCORE_LIMIT:.1f}f : score)"
        f" * {_float(32767 / SCORE_LIMIT)};",
        "    return (int16_t)(score < 0.0f ? score - 0.5f : score + 0.5f);",
        "}\n",
        TANH,
        "/* Amplitude fraction for a window of scores, oldest first. */",
        "betaloop_linkage float betaloop_fraction(const int16_t *scores) {",
        *(f"    int16_t hidden_{i + 1}[{layer.bias.size}];" for i, layer in enumerate(fixed.layers[:-1])),
        *(["    float real;"] if any(not layer.multiplier.size for layer in fixed.layers[:-1]) else []),
        "    int64_t total = 0;",
        "    int32_t " + ", ".join(f"sum_{p}" for p in range(fixed.planes)) + ";",
        "    int i, j;",
    ]
    for index, layer in enumerate(fixed.layers):
        source = "scores" if index == 0 else f"hidden_{index}"
        parts += [f"    for (i = 0; i < {layer.bias.size}; ++i) {{"]
        parts += [f"        sum_{p} = 0;" for p in range(fixed.planes)]
        parts += [f"        for (j = 0; j < {layer.planes[0].shape[1]}; ++j) {{"]
        parts += [f"            sum_{p} += (int32_t)betaloop_plane_{index}_{p}[i][j] * {source}[j];" for p in range(fixed.planes)]
        finer = "" if fixed.planes == 1 else " * 256 + sum_1"
        parts += ["        }", f"        total = ((int64_t)sum_0 + betaloop_bias_{index}[i]){finer};"]
        if layer.multiplier.size:
            parts += [
                "        if (total < 0) total = 0;",
                f"        total = (total * betaloop_multiplier_{index}[i] + ((int64_t)1 << {layer.shift - 1})) >> {layer.shift};",
                f"        hidden_{index + 1}[i] = (int16_t)(total > 32767 ? 32767 : total);",
            ]
        elif index < len(fixed.layers) - 1:
            parts += [
                f"        real = betaloop_tanh((float)total * betaloop_unit_{index}[i]) * 32767.0f;",
                f"        hidden_{index + 1}[i] = (int16_t)(real < 0.0f ? real - 0.5f : real + 0.5f);",
            ]
        parts.append("    }")
    unit = _float(fixed.layers[-1].unit[0])
    parts += [*_answer(f"(float)total * {unit}", fixed.output), "}\n", ENVELOPE]
    return "\n".join(parts)


def _answer(total: str, output: Output) -> list[str]:
    """Write the C lines from the last sum to the fraction; a sum that is no number stays none, so that the envelope sees it."""
    bent = f"betaloop_tanh({total})" if output.kind == "tanh" else total
    lines = [f"    float answer = {_float(output.gain)} * ({bent}) + {_float(output.offset)};"]
    lines += [] if output.low is None else [f"    if (answer < {_float(output.low)}) answer = {_float(output.low)};"]
    lines += [] if output.high is None else [f"    if (answer > {_float(output.high)}) answer = {_float(output.high)};"]
    return ["    {", *(f"    {line}" for line in lines), "        return answer;", "    }"]


def self_test(
    manifest: BundleManifest,
    header: str,
    windows: NDArray[np.float64],
    expected: NDArray[np.float64],
    steps: Sequence[Step],
    tolerance: float,
    *,
    exact: bool,
) -> str:
    """Write a program that includes a header, runs the test vectors through it and exits 0 when every answer is right.

    Args:
        manifest: of the bundle. header: file name to include.
        windows: beta windows [M, W]. expected: fractions [M]. steps: one session with everything that can go wrong with beta.
        tolerance: largest difference of a fraction.
        exact: whether the reasons of limits must agree too: not where fractions differ by a bound.
    """
    milli = [_milliseconds(step) for step in steps]
    rows = ",\n    ".join(
        f"{{{_int64(now)}, {_int64(t)}, {_float(step.beta if step.finite else 0.0)}, {_float(step.amplitude_ma)}, "
        f"{string_literal(step.unit)}, {string_literal(step.source)}, {int(step.t_s is not None)}, {int(step.finite)}, {step.reasons}u}}"
        for step, (now, t) in zip(steps, milli, strict=True)
    )
    return "\n".join(
        [
            f"/* Self-test of the controller of participant {comment(manifest.participant)}, policy {manifest.policy_id}. */",
            "#include <stdio.h>",
            f'#include "{header}"',
            "",
            f"#define WINDOWS {len(windows)}",
            f"#define STEPS {len(steps)}",
            f"#define TOLERANCE {tolerance!r}",
            f"#define TOLERANCE_MA {tolerance * manifest.cdbs_ma + 2e-6!r}",
            f"#define FALLBACK_REASONS {ALL_REASONS if exact else ALL_REASONS & ~LIMIT_REASONS}u",
            f"static const float windows[WINDOWS][BETALOOP_WINDOW] = {{\n    {{{_rows(windows)}}}}};",
            f"static const float expected[WINDOWS] = {{{_floats(expected)}}};",
            "static volatile float zero = 0.0f;",
            "static const struct {",
            "    int64_t now_ms, t_ms;",
            "    float beta, amplitude_ma;",
            "    const char *unit, *source;",
            "    int came, valid;",
            "    uint32_t reasons;",
            f"}} steps[STEPS] = {{\n    {rows}}};",
            "",
            SELF_TEST,
        ]
    )


def _preamble(manifest: BundleManifest, kind: str) -> str:
    limits = manifest.limits()
    period = _whole_ms(limits.period_s)
    low, high = np.float32(limits.min_ma), np.float32(limits.max_ma)
    if float(low) < limits.min_ma:  # constants are rounded to the inside of the clinician's limits
        low = np.nextafter(low, np.float32(np.inf))
    if float(high) > limits.max_ma:
        high = np.nextafter(high, np.float32(0))
    cdbs = min(max(np.float32(limits.cdbs_ma), low), high)
    snapshot = f"snapshot {manifest.snapshot_sha256}" if manifest.snapshot_sha256 else "no snapshot: trained outside this study"
    use = "approved" if manifest.approvals else "NOT APPROVED: not to be used on a participant"
    return f"""\
/* Controller of participant {comment(manifest.participant)}: policy {manifest.policy_id}, {comment(manifest.policy_name)}.
 * {comment(kind)}; {comment(use)}.
 * Made by betaloop {comment(manifest.code_version)} from {comment(snapshot)}.
 * Each period: betaloop_decide(). Nothing is allocated and no library is needed. One controller per translation unit. */
#ifdef BETALOOP_CONTROLLER_H
#error "include one betaloop controller per translation unit"
#endif
#define BETALOOP_CONTROLLER_H
#ifndef betaloop_linkage
#define betaloop_linkage static inline /* empty: a library that others may call */
#endif

#include <stdint.h>

#define BETALOOP_WINDOW {limits.window}
#define BETALOOP_PERIOD_MS {period}
#define BETALOOP_STALE_AFTER_MS {round(1000 * limits.stale_after_s)}
#define BETALOOP_CLOSEST_MS {round((1 - SPACING_TOLERANCE) * period)}
#define BETALOOP_FARTHEST_MS {round((1 + SPACING_TOLERANCE) * period)}
#define BETALOOP_UNIT {string_literal(manifest.beta_unit)}
#define BETALOOP_SOURCE {string_literal(manifest.beta_source)}
#define BETALOOP_MIN_MA {_float(low)}
#define BETALOOP_MAX_MA {_float(high)}
#define BETALOOP_CDBS_MA {_float(cdbs)}
#define BETALOOP_RAMP_MA_PER_S {_float(limits.ramp_ma_per_s)}
#define BETALOOP_FLAG_MA {_float(FLAG_MA)}
#define BETALOOP_BETA_MAX {_float(LARGEST_BETA if limits.beta_max is None else limits.beta_max)}
#define BETALOOP_LEVEL_LOW {_float(limits.level_low or 0.0)}
#define BETALOOP_LEVEL_HIGH {_float(LARGEST_BETA if limits.level_high is None else limits.level_high)}
#define BETALOOP_FROZEN_AFTER {INT32_MAX if limits.frozen_after is None else limits.frozen_after}
#define BETALOOP_MOST_IMPUTED {limits.most_imputed}
#define BETALOOP_CARRIED_OVER {_float(limits.carried_over)}
"""


def _whole_ms(seconds: float) -> int:
    milliseconds = round(seconds * 1000)
    if milliseconds < 1 or abs(milliseconds - seconds * 1000) > 1e-6:
        raise BundleError(f"the C header counts whole milliseconds; {seconds} s are none")
    return milliseconds


def _milliseconds(step: Step) -> tuple[int, int]:
    return round(step.now_s * 1000), 0 if step.t_s is None else round(step.t_s * 1000)


def _int64(value: int) -> str:
    return f"INT64_C({value})"


def _float(value: Any) -> str:
    """Write a float32 so that it reads back as the same number."""
    text = f"{float(np.float32(value)):.9g}"
    return (text if any(c in text for c in ".e") else text + ".0") + "f"


def _floats(values: Iterable[Any]) -> str:
    return _lines([_float(v) for v in values])


def _ints(values: Iterable[Any]) -> str:
    return _lines([str(int(v)) for v in values])


def _rows(rows: NDArray[np.float64]) -> str:
    return "},\n    {".join(_floats(row) for row in rows)


def _lines(texts: list[str]) -> str:
    return ",\n     ".join(", ".join(texts[i : i + _RENDERED_PER_LINE]) for i in range(0, len(texts), _RENDERED_PER_LINE))
