// CRS of the campaign: projection for OpenLayers, and geographic coordinates, checked against PROJ at control points.
import proj4 from 'proj4';
import Projection from 'ol/proj/Projection.js';
import { addProjection } from 'ol/proj.js';
import { register } from 'ol/proj/proj4.js';
import { notice, number } from './dom.js';

const CODE = 'CAMPAIGN';
const WORST_M = 0.01; // tolerated position difference from PROJ, metres
const DEGREE_M = 111320;

export class Places {
  constructor({ crs, grid }) {
    this.grid = grid;
    this.crs = crs;
    // Enough decimals to resolve a tenth of a pixel.
    this.decimals = Math.min(4, Math.max(0, 1 + Math.ceil(-Math.log10(grid.spacing_m))));
    this.toGeographic = crs.local || !crs.proj4 ? null : proj4(crs.proj4, 'WGS84').forward;
    if (this.toGeographic && !(this.errorM() <= WORST_M)) {
      notice(`WGS 84 coordinates are not displayed, because the projection of this page differs from PROJ by ${number(this.errorM(), 3)} m in ${crs.name}.`);
      this.toGeographic = null;
    }
    if (this.toGeographic) {
      proj4.defs(CODE, crs.proj4);
      register(proj4);
    }
    this.projection = new Projection({
      code: CODE,
      units: 'm',
      extent: wider(grid.bounds_m),
      getPointResolution: this.toGeographic ? undefined : (resolution) => resolution,
    });
    if (!this.toGeographic) addProjection(this.projection);
  }

  /** Return the maximum error at the control points, metres. */
  errorM() {
    const errors = this.crs.control.map(([x, y, longitude, latitude]) => {
      const [east, north] = this.toGeographic([x, y]);
      return DEGREE_M * Math.hypot((east - longitude) * Math.cos((latitude * Math.PI) / 180), north - latitude);
    });
    return errors.length ? Math.max(...errors) : Infinity;
  }

  /** Format easting and northing, or x and y of a local frame. */
  words([x, y]) {
    if (!this.toGeographic) return `x ${number(x, this.decimals)} m  y ${number(y, this.decimals)} m`;
    return `E ${number(x, this.decimals)} m  N ${number(y, this.decimals)} m`;
  }

  /** Format latitude and longitude; empty for a local frame. */
  geographicWords(at) {
    if (!this.toGeographic) return '';
    const [longitude, latitude] = this.toGeographic([...at]);
    const decimals = this.decimals + 5;
    const part = (degrees, ahead, behind) => `${number(Math.abs(degrees), decimals)}° ${degrees < 0 ? behind : ahead}`;
    return `${part(latitude, 'N', 'S')}  ${part(longitude, 'E', 'W')}`;
  }

  /** Return the angle of true north to the right of grid north, degrees; null for a local frame. */
  convergence() {
    if (!this.toGeographic) return null;
    const [west, south, east, north] = this.grid.bounds_m;
    const [x, y] = [(west + east) / 2, (south + north) / 2];
    const [from, to] = [this.toGeographic([x, y]), this.toGeographic([x, y + 100])];
    const right = (to[0] - from[0]) * Math.cos((from[1] * Math.PI) / 180);
    return (-Math.atan2(right, to[1] - from[1]) * 180) / Math.PI;
  }

  /** Return fractional row and column of a point; integers are pixel centres. */
  pixelOf([x, y]) {
    const [west, , , north] = this.grid.bounds_m;
    return [(north - y) / this.grid.spacing_m - 0.5, (x - west) / this.grid.spacing_m - 0.5];
  }

  /** Return easting and northing of a point given as row and column. */
  placeOf([row, column]) {
    const [west, , , north] = this.grid.bounds_m;
    return [west + (column + 0.5) * this.grid.spacing_m, north - (row + 0.5) * this.grid.spacing_m];
  }
}

function wider([west, south, east, north]) {
  const margin = 10 * Math.max(east - west, north - south);
  return [west - margin, south - margin, east + margin, north + margin];
}
