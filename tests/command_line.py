"""The program `aniso-pm`, run in this process or as one of its own, and a small scene for it."""

import signal
import subprocess
import sys

import numpy as np
import OpenEXR

SCENE = """<scene version="3.0.0">
  <default name="spp" value="4"/>
  <default name="width" value="16"/>
  <default name="max_depth" value="4"/>
  {integrator}
  <sensor type="perspective">
    <float name="fov" value="39"/>
    <transform name="to_world">
      <lookat origin="0, 0, 3.9" target="0, 0, 0" up="0, 1, 0"/>
    </transform>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="$width"/> <integer name="height" value="16"/>
      <string name="pixel_format" value="rgba"/> <rfilter type="box"/>
    </film>
  </sensor>
  <shape type="rectangle"><bsdf type="diffuse"/></shape>
  <shape type="sphere">
    <point name="center" value="0, 0, 1"/> <float name="radius" value="0.3"/>
    <bsdf type="dielectric"/>
  </shape>
  <shape type="rectangle">
    <transform name="to_world"><rotate y="1" angle="180"/><translate z="4"/></transform>
    <emitter type="area"><rgb name="radiance" value="1"/></emitter>
  </shape>
  {extra}
</scene>
"""
PATH = '<integrator type="path"><integer name="max_depth" value="$max_depth"/></integrator>'
OURS = """<integrator type="aniso_pm">
    <integer name="photon_count" value="20000"/> <integer name="max_depth" value="$max_depth"/>
  </integrator>"""


def assert_one_line(result, *parts):
    status, stdout, stderr = result
    assert status == 2 and stdout == ""
    assert stderr.startswith("aniso-pm: error: ") and stderr.count("\n") == 1, stderr
    for part in parts:
        assert part in stderr


def process(*arguments, cwd, **options):
    command = [sys.executable, "-m", "aniso_pm.cli", *map(str, arguments)]
    return subprocess.Popen(
        command,
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Shells start background jobs with Ctrl-C ignored, and children inherit it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )


def channels(path):
    """Name → pixels, float64."""
    found = OpenEXR.File(str(path), separate_channels=True).channels()
    return {name: channel.pixels.astype(np.float64) for name, channel in found.items()}


def assert_same_picture(a, b):
    """All channels equal, but for the order of float sums in threads (and its square in variances
    that are differences)."""
    a, b = channels(a), channels(b)
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_allclose(a[name], b[name], rtol=0.01, atol=1e-4, err_msg=name)
