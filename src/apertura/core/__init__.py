"""Processing on arrays, from captures to pixels: geometry, scene, antenna, echo, backprojection, imaging, quality.

Provides the building blocks of `ap.backproject`: `geometry.aperture.Aperture`, `scene.grid.SceneGrid`,
`scene.terrain.Terrain`, the engines of `backprojection.engines`, the planner, and measures of image quality. The
package imports only `apertura.common`; it does not open campaign files, read settings or depend on a file format.
"""
