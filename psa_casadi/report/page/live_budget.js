// The error budget at the values that the sliders show: rows of [name, error without it], errors in metres.
psaLive.budget = function (box, rows, now, noise, length) {
  'use strict';
  var make = psaLive.make;
  function above(error) { return Math.sqrt(Math.max(0, error * error - noise * noise)); }
  function cells(tag, texts) {
    return make('tr', {}, texts.map(function (text, k) { return make(tag, {text: text, className: k ? 'figure' : ''}); }));
  }
  box.replaceChildren();
  if (!rows.length || !isFinite(now)) { return; }
  var lines = rows.map(function (row) {
    var without = above(row[1]), share = without > 0 ? 1 - Math.pow(above(now) / without, 2) : 0;
    var removed = isFinite(without) ? Math.round(100 * Math.min(1, Math.max(0, share))) + '\u00a0%' : 'cannot be run';
    return cells('td', [row[0], isFinite(without) ? length(without) : '', removed]);
  });
  box.appendChild(make('p', {className: 'note', text: 'Error above the noise at these values: ' + length(above(now)) +
    ' rms. Without one effect, nothing fitted again (effects that cancel each other in part leave more without one' +
    ' than the base model does):'}));
  box.appendChild(make('table', {}, [
    make('thead', {}, [cells('th', ['without', 'error above the noise', 'it removes'])]), make('tbody', {}, lines)
  ]));
};
