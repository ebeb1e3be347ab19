// A stack to play with: a voltage, any of the effects, and what comes of them.
psaLive.playground = function (box, data, run) {
  'use strict';
  var make = psaLive.make, values = data.parameters.map(function (p) { return p.value; });
  var how = {kind: 'triangle', low: 0, high: 1, frequency: 5, cycles: 3, samples: 2000};
  var stack = data.stacks[0], own = null, played = null, without = {key: ''}, waiting = false, idle = 0, last = null, drawn = null;
  var gains = data.effects.map(function (e) { return data.parameters.findIndex(function (p) { return p.name === e.gain; }); });
  var shown = data.outputs.find(function (o) { return o.name === data.shown; });
  var UM = {unit: '\u00b5m', factor: 1e6};

  function asked(at, t, v, quick) {
    return run({values: at, nominals: stack.nominals, error_sizes: stack.error_sizes, t: t, inputs: {voltage: v}, quick: quick, settle: true});
  }
  function bare() {
    var at = values.slice();
    gains.forEach(function (i) { at[i] = 0; });
    return at;
  }

  // --- what is seen
  var CAPTIONS = ['Voltage', 'Displacement', 'Loop: displacement over voltage', 'What the effects add', 'Current', 'Gain over frequency, small steps'];
  var plots = CAPTIONS.map(function (caption) { return make('div', {className: 'plot', role: 'img', 'aria-label': caption}); });
  var figures = plots.map(function (plot, k) { return make('figure', {}, [make('figcaption', {text: CAPTIONS[k]}), plot]); });
  var output = make('output', {}), status = make('span', {role: 'status'}), beyond = make('p', {className: 'warnings', role: 'alert', hidden: true});
  var legend = make('div', {className: 'legend'});
  [['--model', 'with the effects'], ['--measured', 'without any']].forEach(function (row) {
    var span = make('span', {text: row[1]});
    span.style.setProperty('--own', 'var(' + row[0] + ')');
    legend.appendChild(span);
  });

  function scaled(y, factor) { return y.map(function (x) { return factor * x; }); }
  function span(y) { return Math.max.apply(null, y) - Math.min.apply(null, y); }

  function warn(v) {
    var largest = Math.max(Math.max.apply(null, v), -Math.min.apply(null, v));
    beyond.hidden = !(largest > 1.001 * stack.rated);
    beyond.textContent = beyond.hidden ? '' : 'The voltage reaches ' + +largest.toPrecision(3) + ' V; ' + stack.name + ' is rated for ' +
      +stack.rated.toPrecision(3) + ' V. What is shown beyond that is extrapolated: a stack would saturate, depole or break down.';
  }

  function redraw() {
    if (!waiting) { return; }
    waiting = false;
    var began = performance.now(), base = bare(), t = played.t, v = played.v;
    drawn = null;
    warn(v);
    var now = asked(values, t, v, true), key = JSON.stringify([base, stack.name]);
    if (without.key !== key || without.t !== t || without.v !== v) {
      without = {key: key, t: t, v: v, found: asked(base, t, v, true)};
    }
    var ran = performance.now();
    if (now.status || without.found.status) {
      output.textContent = 'With these values the model cannot be run: ' + (now.reason || without.found.reason) + '.';
      return;
    }
    drawn = now;
    var y = now.outputs[data.shown], y0 = without.found.outputs[data.shown];
    var time = scaled(t, 1e3), um = scaled(y, UM.factor), um0 = scaled(y0, UM.factor);
    var added = y.map(function (x, k) { return 1e9 * (x - y0[k]); });
    var label = 'time [ms]', part = psaLive.stretch(time, zoom.reach), shown = part(time);
    function over(k, unit, rows, still) {
      psaLive.plot(plots[k], {x: label, y: unit, reach: zoom.reach, zooms: !still, curves: rows.map(function (row) {
        return {x: shown, y: part(row[0]), colour: row[1], width: row[2]};
      })});
    }
    over(0, 'voltage [V]', [[v, '--measured']], true);
    over(1, 'displacement [\u00b5m]', [[um0, '--measured', 1], [um, '--model']]);
    psaLive.plot(plots[2], {x: 'voltage [V]', y: 'displacement [\u00b5m]', curves: [
      {x: part(v), y: part(um0), colour: '--measured', width: 1}, {x: part(v), y: part(um), colour: '--model'}]});
    over(3, 'difference [nm]', [[added, '--model']]);
    if (now.outputs.current) {
      over(4, 'current [mA]', [[scaled(without.found.outputs.current, 1e3), '--measured', 1], [scaled(now.outputs.current, 1e3), '--model']]);
    }
    zoom.listen();
    output.textContent = 'Stroke ' + +(UM.factor * span(y)).toPrecision(4) + ' \u00b5m. The effects add up to ' +
      +Math.max.apply(null, added.map(Math.abs)).toPrecision(3) + ' nm, ' +
      +(100e-9 * Math.max.apply(null, added.map(Math.abs)) / (span(y0) || 1)).toPrecision(2) + ' % of the stroke without them.';
    last = {run: ran - began, draw: performance.now() - ran, samples: t.length};
    clearTimeout(idle);
    idle = setTimeout(answer, 350);
  }

  // The answer to a step of a hundredth of the span, at the middle: its resonances and lags.
  function answer() {
    var n = 4096, dt = 1 / (4e3 * data.band), t = new Float64Array(n), v = new Float64Array(n);
    var middle = 0.5 * (how.low + how.high), small = 0.01 * (how.high - how.low) || 0.01;
    for (var k = 0; k < n; k += 1) { t[k] = k * dt; v[k] = k < 8 ? middle : middle + small; }
    var frequencies = Float64Array.from({length: 160}, function (_, i) {
      return 2 / (n * dt) * Math.pow(n / 8, i / 159);
    });
    var curves = [[bare(), '--measured'], [values, '--model']].map(function (row) {
      var found = asked(row[0], t, v, true);
      if (found.status) { return null; }
      return {x: scaled(frequencies, 1e-3), y: scaled(psaLive.voltages.response(v, found.outputs[data.shown], dt, frequencies), 1e9), colour: row[1]};
    }).filter(Boolean);
    psaLive.plot(plots[5], {x: 'frequency [kHz]', y: 'gain [nm/V]', logx: true, logy: true, curves: curves});
  }

  function later() {
    gains.forEach(function (i, k) {
      data.effects[k].parameters.forEach(function (name) { knobs.row(name).hidden = values[i] === 0; });
    });
    if (waiting) { return; }
    waiting = true;
    requestAnimationFrame(redraw);
    setTimeout(redraw, 60);
  }
  function play() {
    var before = played;
    played = own || psaLive.voltages.made(how);
    if (!before || before.t[before.t.length - 1] !== played.t[played.t.length - 1]) { zoom.forget(); }
    later();
  }
  var zoom = psaLive.zoom([plots[1], plots[3], plots[4]], function () { return [0, 1e3 * played.t[played.t.length - 1]]; }, later);

  // --- what is chosen
  function field(text, input) { return make('label', {className: 'field', text: text}, [input]); }
  function number(name, least) {
    var input = make('input', {type: 'number', step: 'any', value: String(how[name])});
    input.addEventListener('input', function () {
      var given = Number(input.value);
      if (input.value === '' || !isFinite(given) || (least !== undefined && given < least)) { return; }
      how[name] = name === 'samples' ? Math.min(20000, Math.round(given)) : given;
      own = null;
      play();
    });
    return input;
  }
  function select(options, act) {
    var input = make('select', {}, options.map(function (o, k) { return make('option', {value: String(k), text: o}); }));
    input.addEventListener('change', function () { act(Number(input.value)); });
    return input;
  }
  function button(text, act) {
    var node = make('button', {type: 'button', text: text});
    node.addEventListener('click', act);
    return node;
  }
  function take(found, what) {
    status.textContent = found ? found.note || '' : what;
    if (found) { own = found; play(); }
  }
  var fields = {low: number('low'), high: number('high'), frequency: number('frequency', 1e-6), cycles: number('cycles', 0.01), samples: number('samples', 10)};
  var kinds = Object.keys(psaLive.voltages.kinds);
  var file = make('input', {type: 'file', accept: '.csv,.txt,.tsv'});
  file.addEventListener('change', function () {
    if (!file.files.length) { return; }
    file.files[0].text().then(function (text) { take(psaLive.voltages.read(text), 'No time and voltage were found in that file.'); });
  });
  var corners = make('input', {type: 'text', placeholder: '0 0, 0.1 100, 0.3 100, 0.5 20', size: 30});
  corners.addEventListener('change', function () {
    take(psaLive.voltages.corners(corners.value, how.samples), 'Give corners as "seconds volts", in order, with commas between.');
  });

  function setStack(k, anew) {
    stack = data.stacks[k];
    knobs.move(data.parameters.map(function (p, i) {
      return p.name in stack.values ? stack.values[p.name] : anew ? p.value : values[i];
    }), true);
    how.low = 0;
    how.high = stack.rated;
    fields.low.value = '0';
    fields.high.value = String(+stack.rated.toPrecision(4));
    about.textContent = stack.description;
    own = null;
    play();
  }

  // The voltage is drawn with the pointer: what it passes over takes its height.
  plots[0].classList.add('drawn-on');
  (function () {
    var from = null;
    function point(event) {
      var r = plots[0].getBoundingClientRect(), p = plots[0].place, a = p.area;
      var x = Math.min(1, Math.max(0, (event.clientX - r.left - a.left) / a.width));
      var y = Math.min(1, Math.max(0, (a.top + a.height - (event.clientY - r.top)) / a.height));
      return [x, p.reach.y[0] + y * (p.reach.y[1] - p.reach.y[0])];
    }
    plots[0].addEventListener('pointerdown', function (event) {
      zoom.forget();
      from = point(event);
      own = {t: played.t, v: played.v.slice()};
      plots[0].setPointerCapture(event.pointerId);
    });
    plots[0].addEventListener('pointermove', function (event) {
      if (from === null) { return; }
      var to = point(event), a = from[0] <= to[0] ? from : to, b = a === from ? to : from, n = own.v.length - 1;
      own = {t: own.t, v: own.v.slice()};
      for (var k = Math.ceil(a[0] * n); k <= b[0] * n; k += 1) {
        own.v[k] = a[1] + (b[1] - a[1]) * (b[0] > a[0] ? (k / n - a[0]) / (b[0] - a[0]) : 1);
      }
      from = to;
      play();
    });
    ['pointerup', 'pointercancel'].forEach(function (name) { plots[0].addEventListener(name, function () { from = null; }); });
  })();

  // The trajectory that is drawn: another run to a tighter tolerance takes half a minute where the voltage jumps.
  function csv() {
    redraw();
    if (!drawn) { return ''; }
    var names = data.outputs.map(function (o) { return o.name; });
    var head = ['time [s]', 'voltage [V]'].concat(data.outputs.map(function (o) { return o.name + ' [' + o.si + ']'; })).join(',');
    var rows = Array.prototype.map.call(played.t, function (t, k) {
      return [t, played.v[k]].concat(names.map(function (n) { return drawn.outputs[n][k]; })).join(',');
    });
    return [head].concat(rows).join('\n') + '\n';
  }

  var knobs = psaLive.knobs(data, values, later), about = make('p', {className: 'note'});
  var nodes = knobs.nodes(function (p) { return data.of_effects.indexOf(p.name) >= 0; }, [], false);
  var bars = [
    make('div', {className: 'bar'}, [
      field('Stack', select(data.stacks.map(function (s) { return s.name; }), setStack)),
      field('Voltage', select(kinds, function (k) { how.kind = kinds[k]; own = null; play(); })),
      field('from [V]', fields.low), field('to [V]', fields.high), field('frequency [Hz]', fields.frequency),
      field('cycles', fields.cycles), field('samples', fields.samples)
    ]),
    make('div', {className: 'bar'}, [
      field('or corners (s V, s V, ...)', corners), field('or a CSV file', file),
      button('Reset', function () { setStack(data.stacks.indexOf(stack), true); }),
      button('Download CSV', function () { psaLive.save('trajectory.csv', csv(), 'text/csv'); })
    ].concat(data.fmu ? [button('Download FMU', function () {
      psaLive.fmu(data, values, stack).then(function (bytes) {
        psaLive.save(stack.name.replace(/\W/g, '_') + '.fmu', bytes, 'application/octet-stream');
        status.textContent = 'The FMU (FMI 3.0) has C sources and no binaries: compile it, or let its importer do so.';
      });
    })] : []).concat(data.file ? [button('Download MODEL.json', function () {
      psaLive.save('MODEL.json', psaLive.file(data, values, stack), 'application/json');
    })] : [], [status]))
  ];
  bars.concat([about, make('p', {className: 'note', text: 'Draw over the voltage to change it.'}), beyond, legend,
    psaLive.board([
      make('div', {className: 'pair'}, figures.slice(0, 2)), make('div', {className: 'pair'}, figures.slice(2, 4)),
      make('div', {className: 'pair'}, figures.slice(4)), output
    ], plots[2], nodes)]).forEach(function (n) { box.appendChild(n); });
  setStack(0);
  data.effects.forEach(function (e, k) { // page.html#slow_creep begins with that effect
    if (decodeURIComponent(location.hash.slice(1)) !== e.name) { return; }
    var at = values.slice();
    at[gains[k]] = e.on;
    knobs.move(at);
    later();
  });
  window.addEventListener('resize', later);
  window.matchMedia('(prefers-color-scheme: dark)').addEventListener('change', later);
  box.psa = {values: values, last: function () { return last; }, csv: csv, file: function () {
    return psaLive.file(data, values, stack);
  }, set: function (name, value) {
    values[data.parameters.findIndex(function (p) { return p.name === name; })] = value;
    waiting = true;
    redraw();
  }};
};
