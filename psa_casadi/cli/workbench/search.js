// The search as a tree of what was fitted, and where the held-out error goes by now.
desk.search = (function () {
  'use strict';
  var make = desk.make, svg = desk.svg, MOST = 6;

  function named(causes) { return causes.slice().sort().join('+'); }

  function grown(events) {
    var known = {}, best = '';
    events.forEach(function (e) {
      var key = named(e.causes);
      if (!e.causes.length && e.state === 'finished' && e.evidence === 0) { known = {}; }
      var old = known[key];
      known[key] = {causes: old ? old.causes : e.causes, last: e};
      if (e.state === 'visited' || e.state === 'best') { best = key; }
    });
    return {known: known, best: best};
  }

  // The longest beginning of its causes that was fitted itself.
  function parent(known, causes) {
    for (var k = causes.length - 1; k > 0; k -= 1) {
      if (known[named(causes.slice(0, k))]) { return named(causes.slice(0, k)); }
    }
    return '';
  }

  // Share of the base's held-out power above the noise that a hypothesis removes.
  function removes(e) {
    var all = e.base_rms_m * e.base_rms_m - e.noise_rms_m * e.noise_rms_m;
    return all > 0 ? (e.base_rms_m * e.base_rms_m - e.holdout_rms_m * e.holdout_rms_m) / all : NaN;
  }

  function bar(parts, title) {
    var box = svg('svg', {viewBox: '0 0 100 10', preserveAspectRatio: 'none', role: 'img', 'aria-label': title}), at = 0;
    box.append(svg('rect', {x: 0, y: 0, width: 100, height: 10, class: 'track'}));
    parts.forEach(function (p) {
      var width = Math.max(0, Math.min(100 - at, 100 * p.share));
      box.append(svg('rect', {x: at, y: 0, width: width, height: 10, class: p.style}));
      at += width;
    });
    return box;
  }

  function branch(tree, key, most) {
    var node = tree.known[key], e = node.last, from = parent(tree.known, node.causes), length = e.causes.length;
    var added = node.causes.filter(function (c) { return !length || from.split('+').indexOf(c) < 0; });
    var line = make('div', {className: key === tree.best ? 'one best' : 'one'}, make('b', {}, length ? '+ ' + added.map(desk.words).join(', ') : 'base model'));
    if (length && e.score !== null) { line.append(bar([{share: Math.max(0, e.score) / most, style: 'full'}], 'score')); }
    line.append(make('small', {}, (length ? 'score ' + (e.score === null ? 'none' : e.score.toFixed(0)) + ', ' : '') + 'held-out error ' + desk.amount(e.holdout_rms_m, desk.setup.unit)));
    if (key === tree.best) { line.append(make('small', {}, e.state === 'best' ? 'the answer' : 'best so far')); }
    var own = make('li', {}, line);
    var below = Object.keys(tree.known).filter(function (k) { return k && k !== key && parent(tree.known, tree.known[k].causes) === key; });
    below.sort(function (a, b) { return tree.known[b].last.score - tree.known[a].last.score; });
    if (below.length) {
      var list = make('ul');
      below.slice(0, MOST).forEach(function (k) { list.append(branch(tree, k, most)); });
      if (below.length > MOST) {
        list.append(make('li', {}, make('small', {}, 'and less likely: ' + below.slice(MOST).map(function (k) {
          return desk.words(k); }).join('; '))));
      }
      own.append(list);
    }
    return own;
  }

  function budget(shares, left, sentence) {
    var parts = shares.map(function (s, k) { return {share: s.share, style: 'part' + k % 5}; });
    parts.push({share: left, style: 'left'});
    var text = shares.map(function (s) { return s.name + ' ' + (100 * s.share).toFixed(0) + ' %' + (s.more || ''); });
    text.push('left ' + (100 * Math.max(0, left)).toFixed(0) + ' %');
    var legend = make('p', {className: 'note'}, sentence + ' ' + text.join(', ') + '.');
    return [make('div', {className: 'budget'}, bar(parts, text.join(', ')), legend)];
  }

  // A share as it is shown, from 0 to 1.
  function cut(share) { return Math.min(1, Math.max(0, share)); }

  function current(tree) {
    var node = tree.known[tree.best || ''], e = node.last, all = removes(e), shares = [];
    if (!isFinite(all)) { return [make('p', {className: 'note'}, 'The base model leaves no more than noise in held-out samples.')]; }
    node.causes.forEach(function (c) {
      var less = tree.known[named(node.causes.filter(function (o) { return o !== c; }))];
      shares.push({name: desk.words(c), share: cut(less ? all - removes(less.last) : all / node.causes.length)});
    });
    var said = 'Base model ' + desk.amount(e.base_rms_m, desk.setup.unit) + ', best so far ' + desk.amount(e.holdout_rms_m, desk.setup.unit) + ', noise ' + desk.amount(e.noise_rms_m, desk.setup.unit) +
      '. Of the power above the noise:';
    return budget(shares, 1 - all, said);
  }

  function final(found) {
    var shares = found.causes.map(function (c) {
      return {name: desk.words(c.what), share: cut(c.share), more: ' (' + c.interval.map(function (v) { return (100 * cut(v)).toFixed(0); }).join(' to ') + ')'};
    });
    if (found.unnamed) { shares.push({name: 'an unnamed correction would remove', share: cut(found.unnamed.share)}); }
    var left = 1 - cut(found.together.share) - (found.unnamed ? cut(found.unnamed.share) : 0);
    var power = 'excess_rms_m' in found ? desk.length(found.excess_rms_m) + ' rms above the noise of ' + desk.length(found.noise_rms_m)
      : 'the held-out power above the noise';
    return budget(shares, left, 'Of ' + power + ':');
  }

  return function (events, found) {
    desk.el('search').hidden = !events.length;
    if (!events.length) { return; }
    desk.filled(desk.el('tree'), String(events.length) + JSON.stringify(events[0]), function () {
      var tree = grown(events);
      var most = Math.max.apply(null, [1].concat(Object.keys(tree.known).map(function (k) { return tree.known[k].last.score || 0; })));
      return tree.known[''] ? [branch(tree, '', most)] : [];
    });
    desk.filled(desk.el('budget'), JSON.stringify([events.length, found]), function () {
      var tree = grown(events);
      return found ? final(found) : tree.known[''] ? current(tree) : [];
    });
  };
})();
