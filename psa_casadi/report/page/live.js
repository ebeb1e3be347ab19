// A page's model, alive: measured against model, loop and residual, drawn again while one drags.
psaLive.report = function (box, data, run) {
  'use strict';
  var make = psaLive.make, values = data.parameters.map(function (p) { return p.value; });
  var fitted = values.slice(), record = null, waiting = false, corrected = {checked: false}, last = null, idle = 0;
  var index = {};
  data.parameters.forEach(function (p, i) { index[p.name] = i; });

  data.records.forEach(function (r) {
    r.t = r.t ? psaLive.doubles(r.t) : Float64Array.from({length: r.n}, function (_, k) { return k * r.step; });
    r.measured = psaLive.singles(r.measured);
    r.correction = r.correction ? psaLive.singles(r.correction) : null;
    Object.keys(r.inputs).forEach(function (n) { r.inputs[n] = psaLive.doubles(r.inputs[n]); });
    r.over = r.inputs[r.along] || null;
    r.time = r.t.map(function (t) { return data.time.factor * t; });
    r.shown = r.measured.map(function (y) { return r.length.factor * y; });
    r.judged = judged(r);
  });

  // Samples that errors are of: those held out, else all; and those that find the offset.
  function judged(r) {
    var held = new Uint8Array(r.t.length), any = false;
    r.held.forEach(function (span) { for (var k = span[0]; k <= span[1]; k += 1) { held[k] = 1; any = true; } });
    return {held: held, any: any};
  }

  function rms(r, residual, held) {
    var sum = 0, count = 0;
    for (var k = 0; k < residual.length; k += 1) {
      if (isFinite(residual[k]) && (held === null || r.judged.held[k] === held)) { sum += residual[k] * residual[k]; count += 1; }
    }
    return Math.sqrt(sum / Math.max(1, count));
  }

  function mean(r, residual) {
    var sum = 0, count = 0;
    for (var k = 0; k < residual.length; k += 1) {
      if (isFinite(residual[k]) && !r.judged.held[k]) { sum += residual[k]; count += 1; }
    }
    return count ? sum / count : 0;
  }

  function simulate(r, at, quick, corrects) {
    var found = run({
      values: at, t: r.t, inputs: r.inputs, deviation: r.deviation, start: r.start, hold: r.hold, settle: true, rest: r.rest, quick: quick
    });
    if (found.status) { return found; }
    var y = found.outputs[r.output || data.shown];
    for (var k = 0; k < y.length; k += 1) { y[k] += corrects && r.correction ? r.correction[k] : 0; }
    return {status: 0, way: found.way, y: y};
  }

  function missed(r, y) { return r.measured.map(function (m, k) { return m - y[k]; }); }

  // The sensor's offset is found again for other values, as a fit does: the mean residual stays the fit's.
  function answer(r, quick, at, corrects) {
    var now = simulate(r, at || values, quick, corrects === undefined ? corrected.checked : corrects);
    if (now.status) { return now; }
    var shift = !r.offset ? 0 : mean(r, missed(r, now.y)) - r.center;
    now.y = now.y.map(function (y) { return y + shift; });
    now.residual = missed(r, now.y);
    r.fitted = r.fitted || now.y; // the first run is at the fitted values
    return now;
  }

  // --- what is seen
  var plots = [0, 1, 2].map(function () { return make('div', {className: 'plot', role: 'img'}); });
  var figures = plots.map(function (plot) { return make('figure', {}, [make('figcaption', {}), plot]); });
  var legend = make('div', {className: 'legend'});
  data.legend.forEach(function (row) {
    var span = make('span', {text: row[1]});
    span.style.setProperty('--own', 'var(' + row[0] + ')');
    legend.appendChild(span);
  });
  var output = make('output', {}), budget = make('div', {className: 'budget'}), status = make('span', {role: 'status'});

  function length(size) { return +(record.error.factor * size).toPrecision(3) + (record.error.unit && ' ' + record.error.unit); }

  function say(now) {
    if (now.status) { output.textContent = 'With these values the model cannot be run: ' + now.reason + '.'; return; }
    var which = record.judged.any ? 1 : null, size = rms(record, now.residual, which);
    var was = rms(record, missed(record, record.fitted), which);
    if (data.design) {
      output.textContent = 'Off the ' + data.aim + ' by ' + length(size) + ' rms, ' +
        +(100 * size / record.range).toPrecision(2) + ' % of its range. As it was: ' + length(was) + '.';
      return;
    }
    var text = (record.judged.any ? 'Error on held-out samples' : 'Error') + ': ' + length(size) + ' rms, ' +
      +(100 * size / record.range).toPrecision(2) + ' % of the range. As fitted: ' + length(was) + '; noise, the floor: ' + length(record.floor) + '.';
    var off = data.effects.filter(function (e) { return values[index[e.gain]] === 0 && fitted[index[e.gain]] !== 0; });
    if (off.length) {
      text += ' With ' + off.map(function (e) { return e.title; }).join(' and ') +
        ' off nothing is fitted again: all other values were found together with ' + (off.length > 1 ? 'them' : 'it') + '.';
    }
    if (off.length && off.length === data.effects.length) {
      text += ' The base model, fitted without any effect, leaves ' + length(record.base) + '.';
    } else if (record.base > record.floor && data.extended) {
      var left = Math.max(0, size * size - record.floor * record.floor) / (record.base * record.base - record.floor * record.floor);
      text += left < 1
        ? ' Of the base model\u2019s error above the noise (in power) ' + Math.round(100 * (1 - left)) + ' % is removed.'
        : ' That is more than the base model leaves, which was fitted by itself: ' + length(record.base) + '.';
    }
    output.textContent = text;
  }

  function draw(now) {
    if (now.status) { return; }
    var r = record, f = r.length.factor, g = r.error.factor, model = now.y.map(function (y) { return f * y; });
    var held = r.held.map(function (s) { return [r.time[s[0]], r.time[s[1]]]; });
    var was = r.fitted.map(function (y) { return f * y; });
    var moved = knobs.moved().length > 0 || corrected.checked;
    var part = psaLive.stretch(r.time, zoom.reach), time = part(r.time), measured = {colour: '--measured', width: 3};
    function curve(y, look) { return Object.assign({x: time, y: part(y)}, look); }
    psaLive.plot(plots[0], {
      x: 'time [' + data.time.unit + ']', y: r.labels[0], bands: held, reach: zoom.reach, zooms: true,
      curves: [curve(r.shown, measured)].concat(moved ? [curve(was, {colour: '--fitted', width: 1})] : [])
        .concat([curve(model, {colour: '--model'})])
    });
    if (r.over) {
      psaLive.plot(plots[1], {
        x: r.labels[1], y: r.labels[0],
        curves: [Object.assign({x: part(r.over), y: part(r.shown)}, measured), {x: part(r.over), y: part(model), colour: '--model', width: 1}]
      });
    }
    var ends = [time[0], time[time.length - 1]];
    psaLive.plot(plots[2], {
      x: 'time [' + data.time.unit + ']', y: r.labels[2], bands: held, reach: zoom.reach, zooms: true,
      curves: [curve(now.residual.map(function (e) { return g * e; }), {colour: '--model', width: 1})]
        .concat((r.noise > 0 ? [2, -2] : []).map(function (k) {
          return {x: ends, y: [k * g * r.noise, k * g * r.noise], colour: '--measured', dash: 'dash', width: 1};
        }))
    });
    zoom.listen();
  }

  // What each effect that is on takes off the error now, by itself; when the slider rests.
  function tell() {
    var on = data.effects.filter(function (e) { return values[index[e.gain]] !== 0; }), which = record.judged.any ? 1 : null;
    function size_(found) { return found.status ? NaN : rms(record, found.residual, which); }
    function without(i) {
      var at = values.slice();
      at[i] = 0;
      return size_(answer(record, true, at));
    }
    var rows = on.map(function (e) { return [e.title, without(index[e.gain])]; });
    if (corrected.checked) { rows.push(['unnamed correction', size_(answer(record, true, values, false))]); }
    psaLive.budget(budget, rows, size_(answer(record, true)), record.floor, length);
  }

  function redraw() {
    if (!waiting) { return; }
    waiting = false;
    var began = performance.now(), now = answer(record, true), ran = performance.now();
    say(now);
    draw(now);
    last = {run: ran - began, draw: performance.now() - ran, samples: record.t.length};
    clearTimeout(idle);
    if (!data.design && !now.status) { idle = setTimeout(tell, 300); }
  }
  function later() {
    if (waiting) { return; }
    waiting = true;
    requestAnimationFrame(redraw);
    setTimeout(redraw, 60); // a page that is not seen gets no frames
  }

  var zoom = psaLive.zoom([plots[0], plots[2]], function () {
    return [record.time[0], record.time[record.time.length - 1]];
  }, later);

  // --- what is moved
  var knobs = psaLive.knobs(data, values, later), switches = [];
  if (data.records.some(function (r) { return r.correction; })) {
    corrected = make('input', {type: 'checkbox'});
    corrected.addEventListener('change', later);
    switches.push(make('label', {className: 'switch'}, [
      corrected, document.createTextNode('unnamed correction'), make('small', {text: data.correction})
    ]));
  }
  var chosen = make('select', {}, data.records.map(function (r, k) {
    return make('option', {value: String(k), text: r.name});
  }));
  function choose() {
    var now = values.slice(), corrects = corrected.checked;
    record = data.records[Number(chosen.value)];
    note.textContent = record.note;
    figures.forEach(function (node, k) {
      node.firstChild.textContent = record.captions[k];
      plots[k].setAttribute('aria-label', record.captions[k]);
      node.hidden = !record.captions[k];
    });
    zoom.forget();
    if (!record.fitted) {
      corrected.checked = false;
      knobs.move(fitted);
      answer(record, true);
      corrected.checked = corrects;
      knobs.move(now);
    }
    later();
  }
  chosen.addEventListener('change', choose);
  var note = make('p', {className: 'note'});

  function button(text, act) {
    var node = make('button', {type: 'button', text: text});
    node.addEventListener('click', act);
    return node;
  }
  function named() {
    var found = {};
    data.parameters.forEach(function (p, i) { found[p.name] = values[i]; });
    return JSON.stringify(found);
  }
  var buttons = [
    button('Reset', function () { corrected.checked = false; knobs.move(fitted, true); status.textContent = ''; later(); }),
    button('Copy these values', function () {
      psaLive.copy(named(), function (done) { status.textContent = done ? 'Copied, in SI units.' : 'The browser refused.'; });
    })
  ];
  if (data.file) {
    buttons.push(button('Download MODEL.json', function () {
      psaLive.save('MODEL.json', psaLive.file(data, values), 'application/json');
    }));
  }
  var choice = data.records.length > 1
    ? [make('label', {className: 'field', text: 'Record'}, [chosen])] : [];
  [
    make('div', {className: 'bar'}, choice.concat(buttons, [status])), legend,
    psaLive.board([
      make('div', {className: 'large'}, [figures[0]]), make('div', {className: 'pair'}, [figures[1], figures[2]]), output, budget, note
    ], plots[2], knobs.nodes(function (p) { return p.determined; }, switches))
  ].forEach(function (n) { box.appendChild(n); });
  choose();
  window.addEventListener('resize', later);
  window.matchMedia('(prefers-color-scheme: dark)').addEventListener('change', later);
  // for whoever measures or drives the page by script
  box.psa = {
    values: values, redraw: redraw, last: function () { return last; }, set: function (name, value) {
      var at = values.slice();
      at[index[name]] = value;
      knobs.move(at);
      waiting = true;
      redraw();
    }, answer: function (quick) { return answer(record, quick); }, file: function () { return psaLive.file(data, values); }
  };
};
