"""The Windows library of an FMU, run in Wine, against the one for Linux."""

import os
import shutil
import subprocess
import sys
import zipfile

import pytest
from export_tools import CASES, model_of
from fmpy import read_model_description

from eha_monitor.exports.fmu import CACHE, fmu_of

WINE = shutil.which("wine64") or shutil.which("wine")
# A master of a few lines: x_d is a sine, every hundredth sample is printed.
HOST = r"""
#ifdef _WIN32
#include <windows.h>
#define OPEN(p) LoadLibraryA(p)
#define FIND(h, n) GetProcAddress(h, n)
#else
#include <dlfcn.h>
#define OPEN(p) dlopen(p, 2)
#define FIND(h, n) dlsym(h, n)
#endif
#include <math.h>
#include <stdio.h>
#define GET(t, n) __typeof__(t) *n = (__typeof__(t) *)FIND(h, "fmi2" #n); if (!n) return 1;
int main(int argc, char **argv)
{
    void *h = (void *)OPEN(argv[1]), *callbacks[5] = {0};
    if (argc < 3 || !h) return 2;
    GET(void *(const char *, int, const char *, const char *, void *, int, int), Instantiate)
    GET(int(void *, int, double, double, int, double), SetupExperiment)
    GET(int(void *), EnterInitializationMode)
    GET(int(void *), ExitInitializationMode)
    GET(int(void *, const unsigned *, size_t, const double *), SetReal)
    GET(int(void *, const unsigned *, size_t, double *), GetReal)
    GET(int(void *, double, double, int), DoStep)
    void *m = Instantiate("one", 1, argv[2], "", callbacks, 0, 0);
    if (!m) return 3;
    SetupExperiment(m, 0, 0, 0, 0, 0);
    EnterInitializationMode(m);
    ExitInitializationMode(m);
    unsigned in = 0, out[5] = {100, 101, 102, 103, 104};
    for (int k = 0; k < 1000; k++) {
        double u = 0.01 * sin(2 * 3.14159265358979 * 2 * k * 1e-3), y[5];
        SetReal(m, &in, 1, &u);
        if (DoStep(m, k * 1e-3, 1e-3, 1)) return 4;
        GetReal(m, out, 5, y);
        if (k % 100 == 99)
            printf("%.10g %.10g %.10g %.10g %.10g\n", y[0], y[1], y[2], y[3], y[4]);
    }
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.skipif(WINE is None, reason="needs wine64")
@pytest.mark.timeout(900)  # zig builds its libraries for Windows once
def test_windows_and_linux_give_the_same_numbers(tmp_path):
    pytest.importorskip("ziglang")
    (tmp_path / "host.c").write_text(HOST)
    path = tmp_path / "one.fmu"
    path.write_bytes(fmu_of(model_of(CASES["friction, delay, air"]), {}).content)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    guid, answers = read_model_description(str(path)).guid, {}


    kept = str(CACHE.parent / "zig")
    for target, folder, library, runner in (
            ("x86_64-linux-gnu", "linux64", "my_rig.so", []),
            ("x86_64-windows-gnu", "win64", "my_rig.dll", [WINE])):
        host = tmp_path / f"{folder}.exe"
        subprocess.run([sys.executable, "-m", "ziglang", "cc", "-target", target, "-O2", "-o",
                        str(host), str(tmp_path / "host.c"), "-lm"], check=True,
                       env={**os.environ, "ZIG_GLOBAL_CACHE_DIR": kept,
                            "ZIG_LOCAL_CACHE_DIR": kept})
        run = subprocess.run([*runner, str(host), f"binaries/{folder}/{library}", guid],
                             cwd=tmp_path, check=True, capture_output=True, text=True,
                             env={**os.environ, "WINEDEBUG": "-all"})
        answers[folder] = run.stdout.split()
    assert len(answers["linux64"]) == 50
    assert answers["win64"] == answers["linux64"]
