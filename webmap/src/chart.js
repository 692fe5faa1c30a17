// The map: one raster, or two with a divider, mask overlay, tracks, footprints, targets, line of the cross-section, and
// background tiles.
import Map from 'ol/Map.js';
import View from 'ol/View.js';
import { extend } from 'ol/extent.js';
import { getPointResolution } from 'ol/proj.js';
import { getRenderPixel } from 'ol/render.js';
import Feature from 'ol/Feature.js';
import GeoJSON from 'ol/format/GeoJSON.js';
import LineString from 'ol/geom/LineString.js';
import Point from 'ol/geom/Point.js';
import BackgroundLayer from 'ol/layer/Tile.js';
import TileLayer from 'ol/layer/WebGLTile.js';
import VectorLayer from 'ol/layer/Vector.js';
import GeoTIFF from 'ol/source/GeoTIFF.js';
import VectorSource from 'ol/source/Vector.js';
import XYZ from 'ol/source/XYZ.js';
import Zoom from 'ol/control/Zoom.js';
import { Circle, Fill, Stroke, Style, Text } from 'ol/style.js';
import { maskStyle, rampStyle } from './colours.js';
import { byId, notice } from './dom.js';

const FLIGHTS = ['#22d3ee', '#f472b6', '#a3e635', '#facc15', '#c084fc', '#fb7185'];
const HALO = new Stroke({ color: '#0b1220cc', width: 4 });

/** Return true if the browser supports WebGL, which is required to draw rasters. */
export function canDraw() {
  const canvas = document.createElement('canvas');
  return Boolean(canvas.getContext('webgl') || canvas.getContext('experimental-webgl'));
}

export class Chart {
  constructor(target, places) {
    this.places = places;
    this.rasters = { left: null, right: null };
    this.masks = { left: null, right: null };
    this.divider = 1; // position as a fraction of the width; left of it, the left raster is shown
    this.opacity = 1;
    const { bounds_m: bounds, spacing_m: spacing } = places.grid;
    this.tracks = vector(3, (feature) => trackStyle(feature));
    this.footprints = vector(2, (feature) => footprintStyle(feature));
    this.targets = vector(5, (feature) => targetStyle(feature), true);
    this.line = vector(6, () => LINE);
    this.map = new Map({
      target,
      controls: [new Zoom()],
      layers: [this.footprints, this.tracks, this.targets, this.line],
      view: new View({
        projection: places.projection,
        enableRotation: false,
        minResolution: spacing / 64,
        maxResolution: Math.max(bounds[2] - bounds[0], bounds[3] - bounds[1]) / 50,
        center: [(bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2],
        resolution: 1,
      }),
    });
    this.fit();
    this.map.on('postrender', () => this.scale());
  }

  /** Fit the view to the scene, optionally including the tracks. */
  fit(tracks = false) {
    const extent = [...this.places.grid.bounds_m];
    if (tracks) extend(extent, this.tracks.getSource().getExtent());
    this.view.fit(extent, { padding: [30, 30, 60, 30] });
  }

  get view() {
    return this.map.getView();
  }

  /** Draw background tiles, reprojected from Web Mercator; a tile that cannot be loaded is reported once. */
  background({ url, deepest_zoom: maxZoom }) {
    const source = new XYZ({ url, maxZoom, crossOrigin: 'anonymous', referrerPolicy: 'origin' });
    source.on('tileloaderror', () => {
      notice(`Background tiles of ${new URL(url).host} cannot be loaded. The service must permit other origins (CORS).`);
    });
    this.map.addLayer(new BackgroundLayer({ source, zIndex: -1 }));
  }

  /** Draw a scale bar that represents a round length; its length in pixels and its text are also used by `picture`. */
  scale() {
    const metres = getPointResolution(this.places.projection, this.view.getResolution(), this.view.getCenter(), 'm');
    const most = 140 * metres;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = power * [5, 2, 1].find((each) => each * power <= most);
    const [unit, metre] = length >= 1000 ? ['km', 1000] : length >= 1 ? ['m', 1] : ['cm', 0.01];
    this.bar = { length: length / metres, text: `${Number((length / metre).toPrecision(2))} ${unit}` };
    byId('scale').style.width = `${this.bar.length}px`;
    byId('scale').textContent = this.bar.text;
  }

  /** Replace the raster of a side and its colour scale; null removes the raster. */
  show(side, layer, colours, low, high) {
    this.rasters[side] = this.replaced(this.rasters[side], side, layer, () => rampStyle(colours, low, high), 0);
    this.rasters[side]?.setOpacity(this.opacity);
  }

  /** Show a mask over the raster of a side; null removes the mask. */
  mask(side, layer) {
    this.masks[side] = this.replaced(this.masks[side], side, layer, maskStyle, 1);
    this.masks[side]?.setOpacity(0.55);
  }

  fade(opacity) {
    this.opacity = opacity;
    for (const raster of Object.values(this.rasters)) raster?.setOpacity(opacity);
  }

  /** Move the divider between the two rasters to a fraction of the width. */
  divide(share) {
    this.divider = share;
    this.map.render();
  }

  replaced(before, side, layer, style, zIndex) {
    const removeBefore = () => {
      if (before) this.map.removeLayer(before);
      before?.dispose();
    };
    if (!layer || !canDraw()) {
      removeBefore();
      return null;
    }
    const source = new GeoTIFF({
      sources: [{ url: layer.url }],
      normalize: false,
      interpolate: false, // values in dB must not be interpolated linearly
      projection: this.places.projection,
      transition: 0,
    });
    source.on('change', () => {
      if (source.getState() === 'error') explain(layer); // the handler returns nothing, because false would stop the propagation of the event
    });
    const added = new TileLayer({ source, style: style(), zIndex });
    added.on('prerender', (event) => {
      const [width, height] = this.map.getSize();
      const [from, to] = side === 'left' ? [0, this.divider] : [this.divider, 1];
      const [left, bottom] = getRenderPixel(event, [from * width, height]).map(Math.round);
      const [right, top] = getRenderPixel(event, [to * width, 0]).map(Math.round);
      event.context.enable(event.context.SCISSOR_TEST);
      event.context.scissor(left, bottom, right - left, top - bottom);
    });
    added.on('postrender', ({ context }) => context.disable(context.SCISSOR_TEST));
    this.map.addLayer(added);
    this.map.once('rendercomplete', removeBefore); // earlier removal would make the map flicker
    return added;
  }

  /** True if there is no raster, or if the file of the raster has been opened. */
  get drawn() {
    return Object.values(this.rasters).every((raster) => !raster || raster.getSource()?.getState() === 'ready');
  }

  stretch(side, low, high) {
    this.rasters[side]?.updateStyleVariables({ low, high });
  }

  /** Draw the view as it is on the screen. */
  draw(pen) {
    this.map.renderSync();
    for (const canvas of this.map.getViewport().querySelectorAll('.ol-layer canvas, canvas.ol-layer')) {
      if (!canvas.width) continue;
      const { style, parentNode } = canvas;
      const matrix = style.transform.match(/matrix\(([^)]*)\)/)?.[1].split(',').map(Number);
      pen.save();
      pen.globalAlpha = Number(parentNode.style.opacity || style.opacity || 1);
      pen.transform(...(matrix ?? [parseFloat(style.width) / canvas.width, 0, 0, parseFloat(style.height) / canvas.height, 0, 0]));
      pen.drawImage(canvas, 0, 0);
      pen.restore();
    }
  }

  async cover(url) {
    const response = await fetch(url);
    if (!response.ok) throw new Error(`tracks and footprints: ${(await response.text()).trim()}`);
    const features = new GeoJSON().readFeatures(await response.json(), {
      dataProjection: 'EPSG:4326',
      featureProjection: this.places.projection,
    });
    const flights = [...new Set(features.map((feature) => feature.get('flight')))];
    for (const feature of features) {
      feature.set('colour', FLIGHTS[flights.indexOf(feature.get('flight')) % FLIGHTS.length]);
      (feature.get('kind') === 'track' ? this.tracks : this.footprints).getSource().addFeature(feature);
    }
  }

  /** Return true if a layer has lines and all its lines are outside the view. */
  isOutside(name) {
    const lines = this[name].getSource().getFeatures().map((feature) => feature.getGeometry()).filter(Boolean);
    const view = this.view.calculateExtent(this.map.getSize());
    return lines.length > 0 && !lines.some((line) => line.intersectsExtent(view));
  }

  mark(places) {
    const source = this.targets.getSource();
    source.clear();
    source.addFeatures(places.map(({ x_m: x, y_m: y, name }) => new Feature({ geometry: new Point([x, y]), name })));
  }

  drawLine(ends) {
    const source = this.line.getSource();
    source.clear();
    if (ends) source.addFeature(new Feature(new LineString(ends)));
  }

  zoomTo(place) {
    const resolution = Math.min(this.view.getResolution(), this.places.grid.spacing_m / 4);
    this.view.animate({ center: place, resolution, duration: 250 });
  }
}

async function explain(layer) {
  const answer = await fetch(layer.url, { headers: { Range: 'bytes=0-0' } }).catch(() => null);
  const reason = answer === null ? 'the server does not respond' : answer.ok ? 'not a valid GeoTIFF' : await answer.text();
  notice(`${layer.file} cannot be displayed: ${reason.trim()}.`);
}

function vector(zIndex, style, declutter = false) {
  return new VectorLayer({ source: new VectorSource(), zIndex, style, declutter });
}

const LINE = [
  new Style({ stroke: new Stroke({ color: '#0b1220', width: 5 }) }),
  new Style({ stroke: new Stroke({ color: '#fde047', width: 2.5 }) }),
];

const trackStyle = (feature) =>
  new Style({
    stroke: new Stroke({
      color: feature.get('colour'),
      width: 2,
      lineDash: feature.get('antenna') === 'receiver' ? [6, 5] : undefined,
    }),
  });

const footprintStyle = (feature) => new Style({ stroke: new Stroke({ color: `${feature.get('colour')}99`, width: 1 }) });

const targetStyle = (feature) =>
  new Style({
    image: new Circle({ declutterMode: 'none', radius: 8, stroke: new Stroke({ color: '#34d399', width: 1.5 }), fill: new Fill({ color: '#0000' }) }),
    text: new Text({
      text: feature.get('name'),
      font: '12px system-ui, sans-serif',
      offsetY: -16,
      fill: new Fill({ color: '#d1fae5' }),
      stroke: HALO,
    }),
  });
