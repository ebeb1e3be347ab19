// Curves that plotly draws again at every move of a slider: as few points as are seen, no hover.
psaLive.plot = (function () {
  'use strict';
  var STRETCHES = 250;

  function ends(curves, which, log) {
    var low = Infinity, high = -Infinity;
    curves.forEach(function (c) {
      c[which].forEach(function (v) {
        if (v < low && (!log || v > 0)) { low = v; }
        if (v > high) { high = v; }
      });
    });
    if (!(high >= low)) { return [0, 1]; }
    if (log) { return [Math.log10(low), Math.log10(Math.max(high, 1.01 * low))]; }
    var room = high > low ? 0.03 * (high - low) : 0.5 * Math.abs(high) || 0.5;
    return which === 'y' ? [low - room, high + room] : [low, high > low ? high : low + 1];
  }

  // Of a long curve first, least and greatest of every stretch, over both axes: its outline stays.
  function outline(c) {
    var n = c.x.length, x = [], y = [];
    if (n <= 5 * STRETCHES) { return c; }
    for (var s = 0; s < STRETCHES; s += 1) {
      var begin = Math.floor(s * n / STRETCHES), end = Math.floor((s + 1) * n / STRETCHES), at = [begin, begin, begin, begin, begin];
      for (var k = begin; k < end; k += 1) {
        if (c.x[k] < c.x[at[1]]) { at[1] = k; }
        if (c.x[k] > c.x[at[2]]) { at[2] = k; }
        if (c.y[k] < c.y[at[3]] || isNaN(c.y[at[3]])) { at[3] = k; }
        if (c.y[k] > c.y[at[4]] || isNaN(c.y[at[4]])) { at[4] = k; }
      }
      at.sort(function (a, b) { return a - b; }).forEach(function (k, i) {
        if (i && at[i - 1] === k) { return; }
        x.push(c.x[k]);
        y.push(c.y[k]);
      });
    }
    x.push(c.x[n - 1]);
    y.push(c.y[n - 1]);
    return Object.assign({}, c, {x: x, y: y});
  }

  // data: x and y (labels), curves of {x, y, colour (a custom property), width, dash}, bands [from, to]
  // over x, logx, logy, zooms (a stretch of x may be chosen).
  return function (box, data) {
    var margin = {l: box.clientWidth < 360 ? 52 : 62, r: 12, t: 8, b: 42};
    var style = getComputedStyle(box), reach = {x: data.reach || ends(data.curves, 'x', data.logx), y: ends(data.curves, 'y', data.logy)};
    function ink(name) { return style.getPropertyValue(name).trim(); }
    function axis(which) {
      return {
        title: {text: data[which], standoff: 4}, range: reach[which], type: data['log' + which] ? 'log' : 'linear', zeroline: false,
        showline: true, mirror: true, linecolor: ink('--quiet'), gridcolor: ink('--line'), fixedrange: which === 'y' || !data.zooms,
        dtick: data['log' + which] ? 1 : undefined
      };
    }
    box.place = {reach: reach, area: {
      left: margin.l, top: margin.t, width: box.clientWidth - margin.l - margin.r, height: box.clientHeight - margin.t - margin.b
    }};
    Plotly.react(box, data.curves.map(function (c) {
      var shown = outline(c);
      return {
        type: 'scatter', mode: 'lines', x: shown.x, y: shown.y, hoverinfo: 'skip',
        line: {color: ink(c.colour), width: c.width || 1.5, dash: c.dash || 'solid'}
      };
    }), {
      template: {}, margin: margin, width: box.clientWidth, height: box.clientHeight, showlegend: false, hovermode: false,
      paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)', font: {size: 12, color: ink('--quiet'), family: 'system-ui, sans-serif'},
      dragmode: data.zooms && !psaPage.finger ? 'zoom' : false, xaxis: axis('x'), yaxis: axis('y'),
      shapes: (data.bands || []).map(function (b) {
        return {type: 'rect', yref: 'paper', x0: b[0], x1: b[1], y0: 0, y1: 1, fillcolor: ink('--held'), line: {width: 0}, layer: 'below'};
      })
    }, {displayModeBar: false, staticPlot: !data.zooms, doubleClick: 'autosize'});
  };
})();

// What picks the samples of a stretch of time, all of them without one.
psaLive.stretch = function (time, reach) {
  'use strict';
  if (!reach) { return function (values) { return values; }; }
  var first = time.findIndex(function (t) { return t >= reach[0]; }), last = time.length;
  while (last > first && time[last - 1] > reach[1]) { last -= 1; }
  return function (values) { return values.subarray(first, last); };
};

// A stretch of time is chosen by dragging over a plot, or by keys; all plots over time show it.
psaLive.zoom = function (boxes, whole, changed) {
  'use strict';
  var zoom = {reach: null, forget: function () { zoom.reach = null; }};

  function set(low, high) {
    var full = whole(), span = Math.min(high - low, full[1] - full[0]);
    var begin = Math.min(Math.max(low, full[0]), full[1] - span);
    zoom.reach = span >= 0.999 * (full[1] - full[0]) ? null : [begin, begin + span];
    changed();
  }

  function keys(event) {
    var now = zoom.reach || whole(), span = now[1] - now[0], middle = 0.5 * (now[0] + now[1]);
    var moves = {
      '+': [middle - 0.25 * span, middle + 0.25 * span], '-': [middle - span, middle + span],
      ArrowLeft: [now[0] - 0.2 * span, now[1] - 0.2 * span], ArrowRight: [now[0] + 0.2 * span, now[1] + 0.2 * span],
      '0': whole(), Escape: whole()
    };
    var wanted = moves[event.key === '=' ? '+' : event.key];
    if (!wanted || event.ctrlKey || event.metaKey) { return; }
    event.preventDefault();
    set(wanted[0], wanted[1]);
  }

  boxes.forEach(function (box) {
    box.tabIndex = 0;
    box.title = 'Drag over a stretch to see it alone, double-click for all; keys: + - 0 and arrows.';
    box.addEventListener('keydown', keys);
  });
  // plotly tells of what was dragged once it has drawn in a box
  zoom.listen = function () {
    boxes.forEach(function (box) {
      if (box.heard || !box.on) { return; }
      box.heard = true;
      box.on('plotly_relayout', function (moved) {
        if ('xaxis.range[0]' in moved) { set(moved['xaxis.range[0]'], moved['xaxis.range[1]']); }
        if (moved['xaxis.autorange']) { set(whole()[0], whole()[1]); }
      });
    });
  };
  return zoom;
};
