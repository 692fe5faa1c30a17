"""From captures to pixels, on arrays: geometry, scene, antenna, echo, backprojection, imaging, planning, quality.

Offers what `ap.backproject` is made of: `geometry.aperture.Aperture`, `scene.grid.SceneGrid`, `scene.terrain.Terrain`,
the engines of `backprojection.engines`, the planner, and what is measured on images. Imports `apertura.common` alone;
never opens a file of a campaign, reads no settings, and knows no format.
"""
