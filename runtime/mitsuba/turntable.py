"""Turn the camera of any scene, at 1 spp: python turntable.py SCENE.xml FOLDER FRAMES DEGREES_A_FRAME WIDTH HEIGHT."""

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
from onespp_mitsuba import GUIDES, Denoiser

if len(sys.argv) != 7:
    sys.exit(__doc__)
path, folder, frames, degrees, width, height = sys.argv[1:]
Path(folder).mkdir(parents=True, exist_ok=True)
mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(path)
sensor = scene.sensors()[0]
camera = mi.traverse(sensor)
camera["film.size"] = [int(width), int(height)]
pose = mi.AffineTransform4f(camera["to_world"])  # a copy: the parameter itself changes with the camera
centre = scene.bbox().center()
up = np.eye(3)[np.abs(np.array(pose.matrix)[:3, 1]).argmax()].tolist()  # the world's axis that is most upright
integrator = mi.load_dict({"type": "onespp_guides", "light": scene.integrator() or {"type": "path"}})
denoiser = Denoiser([int(width), int(height)], albedo=True, normals=True, temporal=True)
for frame in range(int(frames)):
    turn = mi.AffineTransform4f().translate(centre).rotate(up, frame * float(degrees)).translate(-centre)
    camera["to_world"] = turn @ pose
    camera.update()
    mi.render(scene, sensor=sensor, integrator=integrator, spp=1, seed=frame)
    denoiser(sensor.film().bitmap(), **GUIDES, sensor=sensor).write(f"{folder}/{frame:04}.exr")
