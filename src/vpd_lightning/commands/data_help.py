"""What ``vpd-data --help`` prints."""

from data_gen.presets import scene_description, scene_names


def scene_lines() -> str:
    """What can be generated, one line each."""
    lines = (f"{name:<37} {scene_description(name)}".rstrip() for name in scene_names())
    return "\n                ".join(lines)


HELP = f"""vpd-data: make, bring in, look at and check data sets of posed RGB-D video

  vpd-data generate scene=NAME preset=paper|tiny out=FOLDER [seed=0] [renderer=...] [workers=N] [SETTING=VALUE ...]
      Simulate and render. Resumes where it stopped; the same seed gives the same files, whatever the workers.
      scene     {scene_lines()}
      preset    paper: the paper's counts and sizes (half an hour to 90 minutes on two cores); tiny: seconds
      renderer  auto (EGL, then OSMesa), egl, osmesa, blender (docs/blender.md), raycast (mujoco_block without GL)
      workers   processes; all cores by default; never changes the data
      sensor    none, structured_light, active_stereo, time_of_flight: what the cameras get wrong (docs/datasets.md)
      shard     i/n: the i-th of n parts, on one of several machines; the last one to end finishes the set (also import)
      SETTING   any setting of the preset, for example splits.train=8 camera.num_views=4 block.side=0.2

  vpd-data import SOURCE out=FOLDER [format=auto] [SETTING=VALUE ...]
      Bring in recordings. Resumes where it stopped; docs/your_data.md describes formats and settings.
      format    plain (images, depth, cameras.json), transforms (nerfstudio, instant-ngp), kubric, movi (TFDS records),
                tum (TUM RGB-D), ros (bags), lerobot; auto recognises them
      SETTING   every=2 clip_frames=48 height=128 width=128 crop=[0,0,480,480] frame_time=0.05
                flying_pixels=0.02 smooth=2 fill_holes=10 (cleaning depth) refine_poses=true (fixed cameras)
                near=0.3 far=3 workspace_min=[-1,-1,0] workspace_max=[1,1,1] splits.test=0.2
                depth=z|distance depth_scale=0.001 axes=opencv|opengl pixel_center=0.5|0.0 scale=... up=z mapping=FILE

  vpd-data inspect FOLDER [out=FOLDER]
      Print what is in a data set (or one .h5 file); draw a contact sheet, a camera plot and the merged point cloud.

  vpd-data validate FOLDER
      Check every file and checksum, and whether depths and poses of the views agree; names each fault, and the
      convention that would make disagreeing views agree. vpd-train refuses what failed, and imports never validated.

  vpd-data split FOLDER train=0.8 validation=0.1 test=0.1 [seed=0]
      Divide the recordings of a data set anew (shares or counts); pieces of one recording stay together. Before
      the training: vpd-eval refuses what was trained on.

Examples
  vpd-data generate scene=mujoco_block preset=demo out=datasets/mujoco_block_demo
  vpd-data generate scene=deformable_collision preset=paper out=datasets/deformable_collision seed=1 workers=8
  vpd-data generate scene=movi_c preset=tiny out=datasets/my_scans objects.mesh_folder=my_scans
  vpd-data import recordings/kitchen out=datasets/kitchen height=128 width=128
  vpd-data inspect datasets/mujoco_block_demo
  vpd-data validate datasets/mujoco_block_demo

Exit codes: 0 ok, 2 wrong arguments, 3 bad or missing data (or no GL), 5 out of memory, 130 Ctrl-C, 143 SIGTERM.
debug=true adds the traceback to an error.
"""
