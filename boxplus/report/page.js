// Unpacks the library and the figures of a report and draws them: for light and dark pages, for wide and narrow ones.
const NIGHT = {
  '"white"': '"#1d242b"', '#22303c': '#dfe6ec', '#2a3f5f': '#dfe6ec', '#6b7a8f': '#93a1b3', '#e4e8ec': '#36404a',
  'rgba(255,255,255,0.8)': 'rgba(29,36,43,0.8)', '#E5ECF6': '#1d242b', '#a9b5c1': '#5d6874',
  '#c9d3dc': '#33415c', '#93abc2': '#5c7594', '#5c7594': '#93abc2', '#33415c': '#c9d3dc',
};
const COLORS = new RegExp(Object.keys(NIGHT).map(key => key.replace(/[().]/g, '\\$&')).join('|'), 'g');
const dark = matchMedia('(prefers-color-scheme: dark)'), narrow = matchMedia('(max-width: 640px)');

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'))).text();
}

// Panels side by side go below each other.
function stack(layout) {
  const names = Object.keys(layout);
  const panels = names.filter(name => /^scene\d*$/.test(name)).map(name => [layout[name].domain, layout[name].domain, name]);
  for (const name of names.filter(name => /^xaxis\d*$/.test(name) && layout[name].domain && layout[name].domain[1] - layout[name].domain[0] < 0.9)) {
    const below = layout['yaxis' + (layout[name].anchor || 'y').slice(1)];
    panels.push([{get x() { return layout[name].domain; }, set x(v) { layout[name].domain = v; }},
                 {get y() { return below.domain || [0, 1]; }, set y(v) { below.domain = v; }}, name]);
  }
  if (panels.length < 2 || !panels.every(([x]) => x && x.x)) return;
  panels.sort(([x1, y1], [x2, y2]) => y2.y[0] - y1.y[0] || x1.x[0] - x2.x[0]);
  const titles = (layout.annotations || []).filter(title => title.xref === 'paper').sort((a, b) => b.y - a.y || a.x - b.x);
  const share = 1 / panels.length, rows = new Set(panels.map(([, y]) => y.y[0].toFixed(3))).size;
  layout.height = Math.max(260, 0.8 * Math.max(layout.height || 450, 360) / rows) * panels.length;
  const pixel = 1 / (layout.height - (layout.margin?.t ?? 100) - (layout.margin?.b ?? 80));
  panels.forEach(([x, y], row) => {
    const top = 1 - row * share;
    x.x = [0, 1];
    y.y = [top - share + 56 * pixel, top - 26 * pixel];  // below it ticks and a title of the axis, above it its own
    if (titles[row]) Object.assign(titles[row], {x: 0.5, y: top - 24 * pixel, yanchor: 'bottom'});
  });
}

function slim(data, layout) {
  stack(layout);
  Object.assign(layout.margin ||= {}, {l: Math.min(layout.margin.l ?? 60, 60), r: 8});
  (layout.font ||= {}).size = 11;
  for (const name of Object.keys(layout).filter(name => /^[xy]axis/.test(name))) layout[name].automargin = true;
  for (const trace of data) {
    const bar = trace.colorbar || trace.marker?.colorbar;
    if (bar) Object.assign(bar, {orientation: 'h', x: 0.5, xanchor: 'center', y: -0.3, yanchor: 'top', thickness: 8, len: 0.9,
                                 title: {...bar.title, side: 'top'}});
    if (trace.marker?.colorbar) trace.marker.showscale = false;
  }
}

function show(place) {
  const text = dark.matches ? place.figure.replace(COLORS, found => NIGHT[found]) : place.figure;
  const {data, layout, config} = JSON.parse(text);
  layout.paper_bgcolor ??= dark.matches ? '#1d242b' : 'white';
  layout.plot_bgcolor ??= layout.paper_bgcolor;
  (layout.font ||= {}).color ??= dark.matches ? '#dfe6ec' : '#22303c';
  if (narrow.matches) slim(data, layout);
  place.style.height = (layout.height || 450) + 'px';
  return Plotly.react(place, data, layout, config);
}

async function draw() {
  const places = [...document.querySelectorAll('.plot')];
  try {
    const library = document.createElement('script');
    library.textContent = await unpacked(document.getElementById('plotly').textContent);
    document.head.append(library);
    for (const place of places) {
      place.figure = await unpacked(place.firstElementChild.textContent);
      place.replaceChildren();
      await show(place);
    }
  } catch (error) {
    for (const place of places) if (!place.figure) place.textContent = 'This browser cannot draw the figure (' + error + '); those in plots/ are the same.';
    return;
  }
  for (const query of [dark, narrow]) query.addEventListener('change', () => places.forEach(show));
}
draw();
