// Asks the server for what has changed, and shows it; all that is chosen lies there, for every tab.
(function () {
  'use strict';
  var el = desk.el, make = desk.make, known = {version: 0, run: 0, events: [], settings: {}}, timer = 0, asked = null;
  var texts = ['columns', 'sample_time', 'stiffness', 'hysteresis'];

  texts.forEach(function (name) {
    el('set-' + name).onchange = function () {
      var given = {};
      given[name] = el('set-' + name).value;
      desk.post('/settings', given);
    };
  });
  desk.setup.effects.forEach(function (name) {
    var box = make('input', {type: 'checkbox', value: name, id: 'out-' + name});
    box.onchange = function () {
      var all = Array.prototype.slice.call(el('effects').querySelectorAll('input:checked'));
      desk.post('/settings', {leave_out: all.map(function (b) { return b.value; })});
    };
    el('effects').append(make('label', {}, box, ' ' + desk.words(name)));
  });
  el('start').onclick = function () { el('start').disabled = true; desk.post('/start'); };
  el('stop').onclick = function () { desk.post('/stop'); };
  el('export').onclick = function () { desk.post('/export'); };

  function settings(given) {
    known.settings = given;
    texts.forEach(function (name) {
      if (document.activeElement !== el('set-' + name)) { el('set-' + name).value = given[name]; }
    });
    desk.setup.effects.forEach(function (name) { el('out-' + name).checked = given.leave_out.indexOf(name) >= 0; });
  }

  // The last message of a command, without what is not for people.
  function progress(run) {
    if (run.status === 'running') { return run.line.trim() || 'starting'; }
    var took = ' after ' + run.seconds.toFixed(0) + ' s';
    if (run.status === 'done') { return 'Done' + took + '.'; }
    return (run.status === 'stopped' ? 'Stopped' : 'Failed') + took + '. ' + run.messages.filter(function (l) {
      return !/^ *diagnosing/.test(l); }).join(' ');
  }

  function running(state) {
    var run = state.run, on = run && run.status === 'running', out = state.export && state.export.status === 'running';
    el('start').disabled = Boolean(on || out || !known.items || !known.items.some(function (i) { return !i.model && !i.held && i.seen && i.seen.record; }));
    el('stop').disabled = !(on || out);
    if (run) {
      el('command-line').hidden = false;
      el('command').textContent = run.command;
      if (run.number !== known.run) { known.run = run.number; known.events = []; }
      known.events = known.events.concat(run.events);
      desk.filled(el('progress'), progress(run), function () { return [progress(run)]; });
      el('printed').hidden = on || !run.printed.length;
      desk.filled(el('printed'), run.printed.join('\n'), function () { return [run.printed.join('\n')]; });
      desk.search(known.events, on ? null : known.result && known.result.budget);
    }
    var made = state.export;
    el('exporting').textContent = !made ? '' : made.status === 'running' ? 'compiling' : made.status === 'done' ? 'written' : made.messages.join(' ');
    return on || out;
  }

  function result(found, files) {
    var names = Object.keys(files);
    known.result = found;
    el('result').hidden = !names.length;
    el('verdict').textContent = !found ? 'There is no verdict; what was found so far is below.' : 'Verdict: ' + desk.words(found.verdict) +
      (found.causes.length ? ': ' + found.causes.map(function (c) { return desk.words(c.effect) + ' (' + (100 * c.confidence).toFixed(0) + ' %)'; }).join(', ') : '') + '.';
    el('export').disabled = !('extended.json' in files);
    desk.filled(el('downloads'), JSON.stringify(files), function () {
      return names.map(function (name) {
        var line = make('li', {}, make('a', {href: '/files/' + encodeURIComponent(name), download: name}, name), make('span', {className: 'note'}, desk.size(files[name])));
        if (name === 'report.html') { line.append(make('a', {href: '/report', target: '_blank', rel: 'noopener'}, 'in a tab of its own')); }
        return line;
      });
    });
    var page = 'report.html' in files ? '/report?run=' + known.run + '.' + files['report.html'] : '';
    el('report').hidden = !page;
    if (page && el('report').getAttribute('src') !== page) { el('report').src = page; }
    if (!page) { el('report').removeAttribute('src'); }
  }

  function shown(state) {
    el('lost').hidden = true;
    if (state.run && state.run.number !== known.run) { known.events = []; }
    if (state.items) {
      known.version = state.version;
      known.items = state.items;
      settings(state.settings);
      desk.files(state.items);
      desk.columns(state.items, state.settings.columns);
      if (state.run && !known.run) { known.run = state.run.number; }
      result(state.result, state.files);
    }
    return running(state);
  }

  desk.look = function () {
    clearTimeout(timer);
    if (asked) { return asked.then(desk.look); }
    var from = '/state?version=' + known.version + '&run=' + known.run + '&seen=' + known.events.length;
    asked = fetch(from).then(function (answer) {
      if (!answer.ok) { throw new Error(answer.status); }
      return answer.json();
    }).then(shown).then(function (busy) { timer = setTimeout(desk.look, busy ? 400 : 1500); }, function () {
      el('lost').hidden = false;
      el('lost').textContent = 'The command that serves this page has ended; start it again in a terminal.';
      el('start').disabled = el('stop').disabled = true;
      timer = setTimeout(desk.look, 3000);
    }).then(function () { asked = null; });
    return asked;
  };

  desk.look();
})();
