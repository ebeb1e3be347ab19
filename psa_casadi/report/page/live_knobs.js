// Sliders for a model's parameters and switches for its effects. Names are text, never markup.
psaLive.make = function (tag, options, children) {
  'use strict';
  var node = document.createElement(tag);
  Object.keys(options || {}).forEach(function (key) {
    if (key === 'text') { node.textContent = options.text; }
    else if (key in node && key !== 'list') { node[key] = options[key]; }
    else { node.setAttribute(key, options[key]); }
  });
  (children || []).forEach(function (child) { node.appendChild(child); });
  return node;
};

// Calls `changed` after every move. `values` are the model's, in SI units, in its own order.
psaLive.knobs = function (data, values, changed) {
  'use strict';
  var make = psaLive.make, STEPS = 1000, count = 0, rows = {}, switches = [];
  var index = {}, started = values.slice();
  data.parameters.forEach(function (p, i) { index[p.name] = i; });

  function share(p, value) {
    var a = p.ends[0], b = p.ends[1];
    if (!(b > a)) { return 0; }
    var at = p.log ? Math.log(value / a) / Math.log(b / a) : (value - a) / (b - a);
    return Math.min(1, Math.max(0, at));
  }
  function at(p, part) {
    var a = p.ends[0], b = p.ends[1];
    return p.log ? a * Math.pow(b / a, part) : a + (b - a) * part;
  }
  function shown(p, value) {
    var rounded = +(p.factor * value + p.shift).toPrecision(6), text = String(rounded);
    return text.length > 9 ? rounded.toExponential() : text;
  }

  function put(name, value, from) {
    var i = index[name], p = data.parameters[i], row = rows[name];
    values[i] = Math.min(p.bounds[1], Math.max(p.bounds[0], value));
    if (row) {
      if (from !== row.range) { row.range.value = String(Math.round(STEPS * share(p, values[i]))); }
      if (from !== row.number) { row.number.value = shown(p, values[i]); }
      row.range.setAttribute('aria-valuetext', shown(p, values[i]) + ' ' + p.unit);
      row.knob.classList.toggle('moved', values[i] !== started[i]);
    }
    switches.forEach(function (s) { if (s.gain === name) { s.box.checked = values[i] !== 0; } });
  }

  function knob(p) {
    var id = 'psa-' + data.number + '-' + (count += 1);
    var range = make('input', {type: 'range', min: '0', max: String(STEPS), step: '1', id: id});
    var number = make('input', {type: 'number', step: 'any', 'aria-label': p.name + ' in ' + p.unit});
    var way = make('div', {className: 'way'}, [range]);
    if (p.interval) {
      var low = share(p, Math.max(p.interval[0], p.log ? p.ends[0] : -Infinity)), high = share(p, p.interval[1]);
      var sure = make('div', {className: 'sure', title: '95 % interval'});
      sure.style.left = 100 * low + '%';
      sure.style.width = Math.max(0.5, 100 * (high - low)) + '%';
      way.appendChild(sure);
    }
    var head = make('div', {className: 'head'}, [
      make('label', {htmlFor: id, text: p.name}),
      make('span', {}, [number, document.createTextNode(' ' + (p.unit === '1' ? '' : p.unit))])
    ]);
    var box = make('div', {className: 'knob'}, [head, way, make('small', {text: p.description})]);
    rows[p.name] = {range: range, number: number, knob: box};
    range.addEventListener('input', function () {
      var exact = Number(range.value) === Math.round(STEPS * share(p, started[index[p.name]]));
      put(p.name, exact ? started[index[p.name]] : at(p, Number(range.value) / STEPS), range);
      changed();
    });
    number.addEventListener('change', function () {
      var given = (Number(number.value) - p.shift) / p.factor;
      put(p.name, number.value !== '' && isFinite(given) ? given : values[index[p.name]]);
      changed();
    });
    put(p.name, values[index[p.name]]);
    return box;
  }

  function effect(e) {
    var box = make('input', {type: 'checkbox'}), on = e.on;
    switches.push({gain: e.gain, box: box});
    box.addEventListener('change', function () {
      var now = values[index[e.gain]];
      if (now !== 0) { on = now; }
      put(e.gain, box.checked ? on : 0);
      changed();
    });
    box.checked = values[index[e.gain]] !== 0;
    return make('label', {className: 'switch'}, [
      box, document.createTextNode(e.title), make('small', {text: e.description})
    ]);
  }

  function group(title, nodes) {
    return nodes.length ? make('fieldset', {}, [make('legend', {text: title})].concat(nodes)) : null;
  }

  return {
    // Switches, then the sliders that `first` chooses, then all others behind a fold.
    nodes: function (first, more, open) {
      var near = data.parameters.filter(first), far = data.parameters.filter(function (p) { return !first(p); });
      var fold = far.length ? make('fieldset', {'aria-label': 'other parameters'}, far.map(knob)) : null;
      return [
        group('Effects', data.effects.map(effect).concat(more || [])),
        group('Parameters', near.map(knob)),
        fold && make('details', {open: Boolean(open) || !near.length}, [make('summary', {text: 'All other parameters (' + far.length + ')'}), fold])
      ].filter(Boolean);
    },
    // Move all sliders; to values that count as not moved, if `settled`.
    move: function (given, settled) {
      if (settled) { started = given.slice(); }
      data.parameters.forEach(function (p, i) { put(p.name, given[i]); });
    },
    row: function (name) { return rows[name].knob; },
    moved: function () { return data.parameters.filter(function (p, i) { return values[i] !== started[i]; }); }
  };
};

// What is moved beside what it changes: the plots stay in sight, on a phone the one on this canvas does.
psaLive.board = function (plots, kept, knobs) {
  'use strict';
  kept.parentNode.classList.add('kept');
  return psaLive.make('div', {className: 'board'}, [
    psaLive.make('div', {className: 'plots'}, plots), psaLive.make('div', {className: 'knobs'}, knobs)
  ]);
};

// Copying and saving, also where the browser has no clipboard for a file from disk.
psaLive.save = function (name, text, type) {
  'use strict';
  var link = psaLive.make('a', {href: URL.createObjectURL(new Blob([text], {type: type})), download: name});
  link.click();
  setTimeout(function () { URL.revokeObjectURL(link.href); }, 1000);
};

psaLive.copy = function (text, then) {
  'use strict';
  function byHand() {
    var area = psaLive.make('textarea', {value: text});
    document.body.appendChild(area);
    area.select();
    var done = document.execCommand('copy');
    area.remove();
    then(done);
  }
  if (!navigator.clipboard) { byHand(); return; }
  navigator.clipboard.writeText(text).then(function () { then(true); }, byHand);
};

// MODEL.json with other values: what no longer holds of it (intervals, evidence) goes.
// Where a `stack` is given, the model is called after it, and effects that are switched off are left out.
psaLive.file = function (data, values, stack) {
  'use strict';
  var content = JSON.parse(data.file), changed = false;
  data.parameters.forEach(function (p, i) {
    var entry = content.parameters[p.name];
    if (!entry || entry.value === values[i]) { return; }
    entry.value = values[i];
    entry.interval = null;
    entry.free = false;
    changed = true;
  });
  if (stack) {
    var off = data.effects.filter(function (e) { return content.parameters[e.gain].value === 0; });
    off.forEach(function (e) { e.parameters.forEach(function (name) { delete content.parameters[name]; }); });
    content.effects = content.effects.filter(function (e) {
      return !off.some(function (o) { return o.name === (e.name || e); });
    });
    content.name = stack.name.replace(/\W/g, '_');
    content.description = stack.description;
    content.identified_from = [];
  }
  if (changed) {
    delete content.evidence;
    content.notes = (content.notes || []).concat('Values were changed by hand in a page.');
  }
  return JSON.stringify(content, null, 2) + '\n';
};
