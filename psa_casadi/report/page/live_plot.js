// Curves on a canvas, quick enough to be drawn again at every move of a slider.
psaLive.plot = (function () {
  'use strict';

  function colour(canvas, name) { return getComputedStyle(canvas).getPropertyValue(name).trim(); }

  // About so many round numbers between two ends.
  function ticks(low, high, count) {
    var raw = (high - low) / count, size = Math.pow(10, Math.floor(Math.log10(raw)));
    var step = size * ([1, 2, 5, 10].find(function (m) { return m * size >= raw; }) || 10);
    var found = [];
    for (var k = Math.ceil(low / step); k * step <= high + 1e-9 * step; k += 1) { found.push(k * step); }
    return {at: found, digits: Math.max(0, -Math.floor(Math.log10(step) + 1e-9))};
  }

  function written(value, digits) {
    if (value !== 0 && (Math.abs(value) >= 1e5 || digits > 5)) { return value.toExponential(1); }
    return value.toFixed(digits);
  }

  function ends(curves, which, log, reach) {
    var low = Infinity, high = -Infinity;
    curves.forEach(function (c) {
      var values = c[which];
      for (var k = 0; k < values.length; k += 1) {
        var v = values[k];
        if (reach && !(c.x[k] >= reach[0] && c.x[k] <= reach[1])) { continue; }
        if (v < low && (!log || v > 0)) { low = v; }
        if (v > high) { high = v; }
      }
    });
    if (!(high >= low)) { return [0, 1]; }
    if (log) { return [Math.log10(low), Math.log10(Math.max(high, 1.01 * low))]; }
    var room = high > low ? 0.03 * (high - low) : 0.5 * Math.abs(high) || 0.5;
    return which === 'y' ? [low - room, high + room] : [low, high > low ? high : low + 1];
  }

  // A line is split where a value is missing; several points in one column of pixels become one stroke.
  function stroke(pen, c, place) {
    var down = false, column = NaN, least = 0, most = 0, last = 0;
    function flush() { if (most > least) { pen.lineTo(column, least); pen.lineTo(column, most); pen.lineTo(column, last); } }
    var dense = c.x.length > 1500;
    for (var k = 0; k < c.x.length; k += 1) {
      var x = place.x(c.x[k]), y = place.y(c.y[k]);
      if (!isFinite(x) || !isFinite(y)) { flush(); least = most = 0; down = false; continue; }
      if (dense && down && Math.round(x) === column) {
        least = Math.min(least, y); most = Math.max(most, y); last = y;
        continue;
      }
      if (dense) { flush(); x = column = Math.round(x); least = most = last = y; }
      if (down) { pen.lineTo(x, y); } else { pen.moveTo(x, y); down = true; }
    }
    flush();
  }

  function dots(pen, c, place) {
    var lastX = NaN, lastY = NaN;
    for (var k = 0; k < c.x.length; k += 1) {
      var x = Math.round(place.x(c.x[k])), y = Math.round(place.y(c.y[k]));
      if ((x === lastX && y === lastY) || !isFinite(x) || !isFinite(y)) { continue; }
      pen.rect(x - 1, y - 1, 2, 2);
      lastX = x;
      lastY = y;
    }
  }

  function axes(pen, told, area, reach, place, ink) {
    [['x', told.x], ['y', told.y]].forEach(function (row) {
      var name = row[0], log = told['log' + name], range = reach[name];
      var scale = log ? {at: [], digits: 0} : ticks(range[0], range[1], name === 'x' ? area.width / 90 : area.height / 45);
      if (log) { for (var p = Math.ceil(range[0]); p <= range[1]; p += 1) { scale.at.push(Math.pow(10, p)); } }
      scale.at.forEach(function (v) {
        var at = Math.round(place[name](v)) + 0.5, text = log ? String(+v.toPrecision(1)) : written(v, scale.digits);
        pen.strokeStyle = ink.grid;
        pen.beginPath();
        if (name === 'x') { pen.moveTo(at, area.top); pen.lineTo(at, area.top + area.height); }
        else { pen.moveTo(area.left, at); pen.lineTo(area.left + area.width, at); }
        pen.stroke();
        pen.fillStyle = ink.text;
        pen.textAlign = name === 'x' ? 'center' : 'right';
        if (name === 'x') { pen.fillText(text, at, area.top + area.height + 15); }
        else { pen.fillText(text, area.left - 6, at + 4); }
      });
    });
    pen.strokeStyle = ink.axis;
    pen.strokeRect(area.left + 0.5, area.top + 0.5, area.width, area.height);
    pen.fillStyle = ink.text;
    pen.textAlign = 'right';
    pen.fillText(told.x, area.left + area.width, area.top + area.height + 31);
    pen.textAlign = 'left';
    pen.fillText(told.y, 4, 13);
  }

  // told: x and y (labels), curves of {x, y, colour (a custom property), width, dots, dash}, bands of
  // {from, to} over x and {low, high} over y, logx, logy.
  return function (canvas, told) {
    var ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    var pen = canvas.getContext('2d');
    var area = {left: 58, top: 22, width: width - 78, height: height - 60};
    var reach = {x: told.reach || ends(told.curves, 'x', told.logx), y: ends(told.curves, 'y', told.logy, told.reach)};
    var ink = {text: colour(canvas, '--quiet'), grid: colour(canvas, '--line'), axis: colour(canvas, '--quiet')};
    function along(range, begin, size, log) {
      var per = size / (range[1] - range[0]);
      return function (v) { return begin + ((log ? Math.log10(v) : v) - range[0]) * per; };
    }
    var place = {
      x: along(reach.x, area.left, area.width, told.logx),
      y: along(reach.y, area.top + area.height, -area.height, told.logy)
    };
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = '12px system-ui, sans-serif';
    pen.lineWidth = 1;
    pen.save();
    pen.beginPath();
    pen.rect(area.left, area.top, area.width, area.height);
    pen.clip();
    pen.fillStyle = colour(canvas, '--held');
    (told.bands || []).forEach(function (b) {
      pen.fillRect(place.x(b[0]), area.top, Math.max(1, place.x(b[1]) - place.x(b[0])), area.height);
    });
    pen.restore();
    axes(pen, told, area, reach, place, ink);
    pen.save();
    pen.beginPath();
    pen.rect(area.left, area.top, area.width, area.height);
    pen.clip();
    told.curves.forEach(function (c) {
      pen.beginPath();
      pen.strokeStyle = pen.fillStyle = colour(canvas, c.colour);
      pen.lineWidth = c.width || 1.5;
      pen.setLineDash(c.dash || []);
      if (c.dots) { dots(pen, c, place); pen.fill(); } else { stroke(pen, c, place); pen.stroke(); }
    });
    pen.restore();
    canvas.place = {x: place.x, y: place.y, area: area, reach: reach};
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
