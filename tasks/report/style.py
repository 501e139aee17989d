"""How report.html looks, and the only thing that moves on it. Nothing here may name an address."""

CSS = """
:root { color-scheme: light dark; --page: #fff; --ink: #1b1f24; --dim: #5c6570; --line: #dde1e6; --card: #f6f7f9;
  --bad: #b3261e; --bad-ground: #fdf1f0; --good: #1a7f4b; --s1: #0f62ae; --s2: #c2500c; --s3: #0b7f62; --s4: #9c3f86;
  --s5: #8a6a00; --s6: #3d7f9e; --bar: #8fb4d6; }
@media (prefers-color-scheme: dark) { :root { --page: #14171b; --ink: #e4e7ea; --dim: #9aa4af; --line: #2c323a;
  --card: #1c2026; --bad: #ff8a80; --bad-ground: #33201f; --good: #5fd39b; --s1: #6cb2ff; --s2: #ff9d5c; --s3: #4fcfae;
  --s4: #e39ad0; --s5: #e3c04a; --s6: #8fd0ea; --bar: #44688a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 32px 24px 64px; max-width: 1080px; background: var(--page); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 26px; margin: 0; font-weight: 650; letter-spacing: -0.01em; }
h2 { font-size: 18px; margin: 44px 0 2px; font-weight: 650; }
h3 { font-size: 14px; margin: 20px 0 6px; font-weight: 600; }
p { margin: 0 0 10px; max-width: 78ch; }
.lead, .dim, figcaption { color: var(--dim); }
.none { color: var(--dim); font-style: italic; }
nav { display: flex; flex-wrap: wrap; gap: 2px 16px; margin: 14px 0 0; font-size: 13px; }
a { color: var(--s1); text-decoration: none; } a:hover { text-decoration: underline; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(134px, 1fr)); gap: 10px; margin: 24px 0 0; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 10px 12px; }
.card b { display: block; font-size: 19px; font-weight: 620; font-variant-numeric: tabular-nums; white-space: nowrap; }
.card span { display: block; font-size: 12.5px; color: var(--dim); }
.card.good b { color: var(--good); } .card.bad b, td.bad { color: var(--bad); }
ul.findings { list-style: none; margin: 14px 0; padding: 10px 14px; border-left: 3px solid var(--bad);
  background: var(--bad-ground); border-radius: 0 6px 6px 0; }
ul.findings li { padding: 1px 0; }
.fine { color: var(--good); margin: 18px 0 0; }
.wide { overflow-x: auto; margin: 10px 0; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 4px 10px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { font-weight: 600; color: var(--dim); font-size: 12.5px; vertical-align: bottom; }
th:first-child, td:first-child, td.text, th.text { text-align: left; padding-left: 2px; }
td.text { white-space: normal; }
td.bad { font-weight: 600; }
.share { display: inline-block; height: 9px; background: var(--bar); border-radius: 2px; vertical-align: baseline; }
svg { display: block; font: 12px system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
svg.chart { width: 100%; min-width: 620px; height: auto; } svg.spark { width: 104px; height: 22px; margin-left: auto; }
svg.rig { width: 100%; height: auto; border: 1px solid var(--line); border-radius: 8px; }
svg text { fill: var(--dim); } svg text.title { fill: var(--ink); font-weight: 600; }
svg .grid { stroke: var(--line); } svg .axis { stroke: var(--dim); fill: none; }
svg .mark { stroke: var(--dim); stroke-dasharray: 3 3; }
svg .line { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
svg .bar { fill: var(--bar); } svg .bar.strong { fill: var(--s2); }
svg path.s1 { stroke: var(--s1); } svg path.s2 { stroke: var(--s2); } svg path.s3 { stroke: var(--s3); }
svg path.s4 { stroke: var(--s4); } svg path.s5 { stroke: var(--s5); } svg path.s6 { stroke: var(--s6); }
svg path.muted { stroke: var(--bar); } svg path.strong { stroke: var(--ink); stroke-width: 2.4; }
svg text.s1 { fill: var(--s1); } svg text.s2 { fill: var(--s2); } svg text.s3 { fill: var(--s3); }
svg text.s4 { fill: var(--s4); } svg text.s5 { fill: var(--s5); } svg text.s6 { fill: var(--s6); }
svg text.strong { fill: var(--ink); font-weight: 600; } svg text.muted { fill: var(--dim); }
svg .red { fill: #d9463c; } svg .green { fill: #2f9e4f; } svg .blue { fill: #3b7de0; }
svg circle.red, svg circle.green, svg circle.blue { fill-opacity: 0.85; }
svg .camera { stroke: var(--s1); fill: var(--s1); fill-opacity: 0.13; stroke-width: 1; }
svg .camera.held { stroke: var(--s2); fill: var(--s2); } svg .camera.dot { fill-opacity: 1; }
svg .name { font-size: 10.5px; paint-order: stroke; stroke: var(--page); stroke-width: 3px; }
svg .name.held { fill: var(--s2); font-weight: 600; }
svg .volume { fill: var(--s3); fill-opacity: 0.1; stroke: var(--s3); stroke-dasharray: 4 3; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 14px; }
.trio { display: grid; grid-template-columns: repeat(3, 1fr); gap: 8px; margin: 6px 0 18px; }
.trio figure, .pair figure { margin: 0; } .trio img { width: 100%; height: auto; display: block; border-radius: 4px; }
figcaption { font-size: 12.5px; padding-top: 3px; }
pre { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 10px 12px; overflow-x: auto;
  font: 12.5px/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; margin: 8px 0; }
details summary { cursor: pointer; color: var(--s1); }
@media (max-width: 700px) { .pair, .trio { grid-template-columns: 1fr; } body { padding: 20px 14px; } }
@media print { body { max-width: none; } h2 { break-after: avoid; } .trio, table { break-inside: avoid; }
  nav { display: none; } }
"""

SCRIPT = """
for (const image of document.querySelectorAll("img[data-blink]")) {
  const own = image.src, truth = image.closest(".trio").querySelector("img").src;
  image.addEventListener("pointerenter", () => { image.src = truth; });
  image.addEventListener("pointerleave", () => { image.src = own; });
}
"""
