"""Engines that this Blender follows: `registry` knows them, `timer` polls them from Blender."""
