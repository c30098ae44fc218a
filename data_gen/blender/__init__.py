"""Pictures of MuJoCo scenes by Blender's path tracer, which runs in a process and an environment of its own."""
