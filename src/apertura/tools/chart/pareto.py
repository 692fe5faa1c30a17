"""Speed-accuracy chart with a point for each setting and the Pareto front, as PNG and as HTML file."""

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from apertura.common.atomic import replacement, write_text
from apertura.core.backprojection.engines import ENGINES

_COLOURS = ("#0072b2", "#e69f00", "#000000", "#cc79a7", "#56b4e9", "#009e73")
_MARKERS = "osD^vP"


@dataclass(frozen=True)
class Point:
    """Time and error of a setting; the time is for the whole image on one thread, extrapolated from the measured part.

    `error_db` is an upper bound with 95 % confidence; None for the exact sum, which is the reference of all errors.
    """

    engine: str
    setting: str
    presum: int
    seconds: float
    pixel_pulses_per_s: float
    error_db: float | None
    predicted_seconds: float
    predicted_error_db: float
    on_front: bool
    planned: bool


def with_front(points: Sequence[Point]) -> list[Point]:
    """Mark the points of the Pareto front, for which no faster point is as accurate, in a list sorted by time."""
    best, marked = float("inf"), []
    for point in points:
        error_db = -np.inf if point.error_db is None else point.error_db
        marked.append(replace(point, on_front=error_db < best))
        best = min(best, error_db)
    return marked


_BESIDE = 3.0  # the exact sum is drawn on the axis if it takes at most this multiple of the slowest other time


def draw_points(points: Sequence[Point], path: Path, *, title: str, accuracy_db: float) -> None:
    """Plot error against time of points sorted by time, with the requested accuracy, as PNG."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots()
    for engine, colour, marker in zip(ENGINES, cycle(_COLOURS), cycle(_MARKERS), strict=False):
        places = _places([point for point in points if point.engine == engine and not point.planned])
        if places[0]:
            axes.plot(*places, linestyle="none", color=colour, marker=marker, alpha=0.6, label=engine)
    slowest_s = max((point.seconds for point in points if point.error_db is not None), default=np.inf)
    front = [point for point in points if point.on_front]
    axes.plot(*_places(front), color="0.4", drawstyle="steps-post", zorder=0, label="Pareto front")
    for point in points:
        if point.error_db is None:
            chosen = "planner's choice: " if point.planned else ""
            label = f"{chosen}exact sum, reference of the errors: {point.seconds:.3g} s"
            if point.seconds <= _BESIDE * slowest_s:
                axes.axvline(point.seconds, color="0.4", linestyle=":", label=label)
            else:  # legend only: a mark would stretch the axis
                axes.plot([], [], color="0.4", linestyle=":", label=f"{label}, beyond the axis")
        elif point.planned:
            presum = f", presum {point.presum}:1" if point.presum > 1 else ""
            label = f"planner's choice: {point.setting}{presum}"
            axes.plot(point.seconds, point.error_db, "*", color="#d55e00", markersize=17, label=label)
    axes.axhline(accuracy_db, color="#009e73", linestyle="--", label=f"requested: {accuracy_db:g} dB")
    axes.set_xscale("log")
    axes.set_xlabel("Time to compute tables and sums of the whole image, one thread, s")
    axes.set_ylabel("Error relative to the exact sum, upper bound with 95 % confidence, dB")
    axes.set_title(title, fontsize=11)
    axes.grid(which="both", alpha=0.25)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    save_png(figure, path)


def _places(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    places = [(point.seconds, point.error_db) for point in points if point.error_db is not None]
    return [seconds for seconds, _ in places], [error_db for _, error_db in places]


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>@TITLE@</title>
<style>
body{font:14px/1.4 system-ui,sans-serif;margin:1.5em auto;max-width:1000px;color:#222}
svg{width:100%;height:auto;border:1px solid #ddd} text{font-size:12px;fill:#444}
#tip{min-height:3.2em;padding:.5em;background:#f6f6f6;border-radius:4px} label{margin-right:1.2em}
table{border-collapse:collapse;width:100%;font-size:12px}
td,th{padding:2px 6px;text-align:right;border-bottom:1px solid #eee}
td:first-child,th:first-child{text-align:left} tr.planned{background:#fbe5d6} tr.front td{font-weight:600}
th{cursor:pointer}
</style>
<h1 style="font-size:18px">@TITLE@</h1>
<p>Each point is one setting of an engine: the time to compute tables and sums of the whole image on one thread, and an
upper bound, with 95 % confidence, of the error relative to the exact sum. Solid line: Pareto front. Star: planner's
choice. Dashed line: requested accuracy. Dotted line: time of the exact sum.</p>
<div id="filters"></div><svg id="chart" viewBox="0 0 960 560" role="img" aria-label="error against time"></svg>
<p id="tip">Move the pointer to a mark to display its values.</p><table id="rows"></table>
<script>
const points = @POINTS@, requested = @REQUESTED@;
const palette = ["#0072b2","#e69f00","#000","#cc79a7","#56b4e9","#009e73"], shown = {};
const colours = Object.fromEntries(@ENGINES@.map((name,i)=>[name,palette[i%palette.length]]));
const box = {left:70,right:930,top:20,bottom:510}, svg = document.getElementById("chart");
const lo = v => Math.floor(Math.log10(Math.min(...v))), hi = v => Math.ceil(Math.log10(Math.max(...v)));
const x0 = lo(points.map(p=>p.seconds)), x1 = Math.max(x0+1,hi(points.map(p=>p.seconds)));
const all = points.map(p=>p.error_db).filter(d=>d!==null).concat(requested);
const y0 = Math.floor(Math.min(...all)/20)*20, y1 = Math.ceil(Math.max(...all)/20)*20;
const X = s => box.left+(Math.log10(s)-x0)/(x1-x0)*(box.right-box.left);
const Y = d => box.top+(y1-d)/(y1-y0)*(box.bottom-box.top);
const make = (name,attributes,text) => {
  const node = document.createElementNS("http://www.w3.org/2000/svg",name);
  for (const key in attributes) node.setAttribute(key,attributes[key]);
  if (text!==undefined) node.textContent = text;
  svg.appendChild(node); return node;
};
const presum = p => p.presum>1 ? `, presum ${p.presum}:1` : "";
const describe = p => `${p.setting}${presum(p)}: ${p.seconds.toPrecision(3)} s `
  +`(predicted ${p.predicted_seconds.toPrecision(3)}), ${p.error_db===null?"reference of the errors"
  :`${p.error_db.toFixed(1)} dB (predicted ${p.predicted_error_db.toFixed(1)})`}, `
  +`${p.pixel_pulses_per_s.toExponential(2)} pixel·pulses/s`
  +(p.planned?" — planner's choice":"")+(p.on_front?" — Pareto-optimal":"");
function draw() {
  svg.replaceChildren();
  for (let e=x0;e<=x1;e++) {
    make("line",{x1:X(10**e),x2:X(10**e),y1:box.top,y2:box.bottom,stroke:"#ddd"});
    make("text",{x:X(10**e),y:box.bottom+18,"text-anchor":"middle"},`${+(10**e).toPrecision(1)} s`);
  }
  for (let d=y0;d<=y1;d+=20) {
    make("line",{x1:box.left,x2:box.right,y1:Y(d),y2:Y(d),stroke:"#ddd"});
    make("text",{x:box.left-8,y:Y(d)+4,"text-anchor":"end"},`${d} dB`);
  }
  make("line",{x1:box.left,x2:box.right,y1:Y(requested),y2:Y(requested),stroke:"#009e73","stroke-dasharray":"6 4"});
  make("text",{x:box.right-4,y:Y(requested)-5,"text-anchor":"end"},`requested: ${requested} dB`);
  make("text",{x:(box.left+box.right)/2,y:box.bottom+40,"text-anchor":"middle"},
    "time to compute tables and sums of the whole image, one thread, s");
  const selected = points.filter(p=>shown[p.engine]); let best = Infinity, path = "";
  for (const p of selected) if (p.error_db!==null && p.error_db<best) {
    path += path ? `H${X(p.seconds)}V${Y(p.error_db)}` : `M${X(p.seconds)},${Y(p.error_db)}`; best = p.error_db;
  }
  if (path) make("path",{d:path,fill:"none",stroke:"#777"});
  for (const p of selected) {
    const mark = p.error_db===null
      ? make("line",{x1:X(p.seconds),x2:X(p.seconds),y1:box.top,y2:box.bottom,stroke:"#777","stroke-dasharray":"2 4"})
      : p.planned
      ? make("text",{x:X(p.seconds),y:Y(p.error_db)+10,"text-anchor":"middle",style:"font-size:30px;fill:#d55e00"},"★")
      : make("circle",{cx:X(p.seconds),cy:Y(p.error_db),r:5,fill:colours[p.engine],"fill-opacity":.65});
    mark.addEventListener("pointerenter",()=>{document.getElementById("tip").textContent = describe(p);});
  }
}
const columns = ["setting","presum","seconds","predicted_seconds","error_db","predicted_error_db",
  "pixel_pulses_per_s"];
function table(by="seconds") {
  const rows = document.getElementById("rows"), head = document.createElement("tr"); rows.replaceChildren(head);
  for (const name of columns) {
    const cell = document.createElement("th"); cell.textContent = name.replaceAll("_"," ");
    cell.addEventListener("click",()=>table(name)); head.appendChild(cell);
  }
  for (const p of [...points].sort((a,b)=>a[by]<b[by]?-1:1)) {
    const row = document.createElement("tr"); row.className = (p.planned?"planned ":"")+(p.on_front?"front":"");
    for (const name of columns) {
      const cell = document.createElement("td"), value = p[name];
      cell.textContent = typeof value==="number" ? +value.toPrecision(4) : value; row.appendChild(cell);
    }
    rows.appendChild(row);
  }
}
for (const engine of new Set(points.map(p=>p.engine))) {
  shown[engine] = true;
  const label = document.createElement("label"), tick = document.createElement("input");
  tick.type = "checkbox"; tick.checked = true; tick.addEventListener("change",()=>{shown[engine]=tick.checked;draw();});
  label.append(tick," "+engine); label.style.color = colours[engine]; document.getElementById("filters").append(label);
}
draw(); table();
</script></html>
"""


def write_page(points: Sequence[Mapping[str, Any]], path: Path, *, title: str, accuracy_db: float) -> None:
    """Write the chart as HTML; points are sorted by time, with the fields of `apertura.tools.chart.pareto.Point`."""
    data = json.dumps(list(points), ensure_ascii=False, allow_nan=False).replace("</", "<\\/")
    page = _PAGE.replace("@TITLE@", html.escape(title)).replace("@REQUESTED@", f"{accuracy_db:g}")
    write_text(path, page.replace("@ENGINES@", json.dumps(list(ENGINES))).replace("@POINTS@", data))


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure as a reproducible PNG file."""
    FigureCanvasAgg(figure)
    with replacement(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110, metadata={"Software": None})
