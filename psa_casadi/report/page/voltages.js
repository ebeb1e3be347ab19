// Voltages to play: made from a few numbers, drawn by hand, typed as corners, or read from a CSV file.
psaLive.voltages = {
  // Share of the span between the lowest and the highest voltage, over cycles.
  kinds: {
    triangle: function (c) { var r = c - Math.floor(c); return r < 0.5 ? 2 * r : 2 - 2 * r; },
    sine: function (c) { return 0.5 - 0.5 * Math.cos(2 * Math.PI * c); },
    steps: function (c) { var r = c - Math.floor(c); return r >= 0.1 && r < 0.6 ? 1 : 0; },
    'loops that shrink': function (c, all) {
      var r = c - Math.floor(c), size = 1 - 0.8 * Math.min(1, Math.floor(c) / Math.max(1, all - 1));
      return 0.5 + size * ((r < 0.5 ? 2 * r : 2 - 2 * r) - 0.5);
    }
  },

  made: function (how) {
    'use strict';
    var n = how.samples, duration = how.cycles / how.frequency, kind = psaLive.voltages.kinds[how.kind];
    var t = new Float64Array(n), v = new Float64Array(n);
    for (var k = 0; k < n; k += 1) {
      t[k] = duration * k / (n - 1);
      v[k] = how.low + (how.high - how.low) * kind(Math.min(how.cycles * k / (n - 1), how.cycles - 1e-9), how.cycles);
    }
    return {t: t, v: v};
  },

  // "0 0, 0.1 100, 0.5 20": corners in seconds and volts, sampled evenly. Null where they are none.
  corners: function (text, samples) {
    'use strict';
    var rows = text.split(/[,;\n]/).map(function (part) { return part.trim().split(/\s+|:/).map(Number); })
      .filter(function (row) { return row.length === 2 && row.every(isFinite); });
    if (rows.length < 2 || rows.some(function (row, i) { return i > 0 && !(row[0] > rows[i - 1][0]); })) { return null; }
    return psaLive.voltages.sampled(rows, samples);
  },

  // So many even samples of the straight lines between rows of [time, voltage].
  sampled: function (rows, samples) {
    'use strict';
    var first = rows[0][0], span = rows[rows.length - 1][0] - first, at = 0;
    var t = new Float64Array(samples), v = new Float64Array(samples);
    for (var k = 0; k < samples; k += 1) {
      t[k] = span * k / (samples - 1);
      while (at < rows.length - 2 && first + t[k] > rows[at + 1][0]) { at += 1; }
      var a = rows[at], b = rows[at + 1];
      v[k] = a[1] + (b[1] - a[1]) * (first + t[k] - a[0]) / (b[0] - a[0]);
    }
    return {t: t, v: v};
  },

  // Time and voltage of a CSV file: columns by their names, else the first two. Null where there are none.
  read: function (text) {
    'use strict';
    var FACTORS = {s: 1, ms: 1e-3, us: 1e-6, '\u00b5s': 1e-6, v: 1, mv: 1e-3, kv: 1e3};
    var lines = text.split(/\r?\n/).filter(function (line) { return line.trim(); });
    var by = /;/.test(lines[0]) ? ';' : /\t/.test(lines[0]) ? '\t' : ',';
    function cells(line) { return line.split(by).map(function (c) { return c.trim(); }); }
    function value(cell) { return cell === undefined || cell === '' ? NaN : Number(by === ',' ? cell : cell.replace(',', '.')); }
    var head = cells(lines[0]).some(function (c) { return isNaN(value(c)); }) ? cells(lines[0]) : [];
    function column(pattern, other) {
      var found = head.findIndex(function (name) { return pattern.test(name); });
      var unit = found >= 0 && /[[(]\s*([^\])]+?)\s*[\])]/.exec(head[found]);
      return {at: found >= 0 ? found : other, factor: (unit && FACTORS[unit[1].toLowerCase()]) || 1};
    }
    var time = column(/^t(ime)?\b/i, 0), volts = column(/^(v(olt|oltage)?|u)\b/i, 1), rows = [];
    lines.slice(head.length ? 1 : 0).forEach(function (line) {
      var row = cells(line), t = time.factor * value(row[time.at]), v = volts.factor * value(row[volts.at]);
      if (isFinite(t) && isFinite(v) && !(rows.length && t <= rows[rows.length - 1][0])) { rows.push([t, v]); }
    });
    if (rows.length < 4) { return null; }
    rows = rows.slice(0, 20000);
    var steps = []; // exact steps know eight lengths; a jitter, or times of few digits, have more
    rows.forEach(function (r, k) {
      var step = k ? r[0] - rows[k - 1][0] : 0;
      if (k && steps.length < 9 && !steps.some(function (s) { return Math.abs(step - s) <= 1e-6 * s; })) { steps.push(step); }
    });
    if (steps.length > 8) {
      return Object.assign(psaLive.voltages.sampled(rows, rows.length), {note: 'Its uneven times were put on an even grid.'});
    }
    return {
      t: Float64Array.from(rows, function (r) { return r[0] - rows[0][0]; }), v: Float64Array.from(rows, function (r) { return r[1]; })
    };
  },

  // Gain over frequency from the answer y to a voltage v, samples of equal steps dt.
  response: function (v, y, dt, frequencies) {
    'use strict';
    function transform(x, f) {
      var re = 0, im = 0, w = 2 * Math.PI * f * dt;
      for (var k = 1; k < x.length; k += 1) {
        var d = x[k] - x[k - 1];
        if (d !== 0) { re += d * Math.cos(w * k); im -= d * Math.sin(w * k); }
      }
      return Math.hypot(re, im);
    }
    return frequencies.map(function (f) { return transform(y, f) / transform(v, f); });
  }
};
