// The files: dropped, chosen, held out, removed.
desk.files = (function () {
  'use strict';
  var make = desk.make, drop = desk.el('drop'), pick = desk.el('pick');

  // One after the other: each is looked at when it has arrived.
  function give(list) {
    return Array.prototype.reduce.call(list, function (before, file) {
      return before.then(function () {
        desk.el('progress').textContent = 'reading ' + file.name;
        return fetch('/files', {method: 'POST', headers: {'X-Name': encodeURIComponent(file.name)}, body: file}).then(desk.answered);
      });
    }, Promise.resolve()).then(function () { desk.el('progress').textContent = ''; });
  }

  pick.onchange = function () { give(Array.prototype.slice.call(pick.files)).then(function () { pick.value = ''; }); };
  window.addEventListener('dragover', function (e) { e.preventDefault(); drop.classList.add('over'); });
  window.addEventListener('dragleave', function () { drop.classList.remove('over'); });
  window.addEventListener('drop', function (e) {
    e.preventDefault();
    drop.classList.remove('over');
    give(Array.prototype.slice.call(e.dataTransfer.files));
  });

  function row(item) {
    var held = make('input', {type: 'checkbox', id: 'held' + item.key, checked: item.held});
    held.onchange = function () { desk.post('/hold', {key: item.key, held: held.checked}); };
    var gone = make('button', {type: 'button', id: 'gone' + item.key, ariaLabel: 'Remove ' + item.name}, 'Remove');
    gone.onclick = function () { desk.post('/remove', {key: item.key}); };
    var line = make('li', {}, make('span', {className: 'name'}, item.name),
      make('span', {className: 'note'}, desk.size(item.size) + (item.stored === item.name ? '' : ', in the report: ' + item.stored)));
    if (item.model) { line.append(make('span', {}, 'start of the base fit')); }
    else { line.append(make('label', {}, held, ' for judging only (held out)')); }
    line.append(gone);
    var problems = item.seen ? item.seen.problems : [];
    if (problems.length) {
      line.append(make.apply(null, ['ul', {className: 'problems warnings'}].concat(problems.map(function (p) { return make('li', {}, p); }))));
    }
    return line;
  }

  return function (items) {
    desk.filled(desk.el('files'), JSON.stringify(items), function () { return items.map(row); });
  };
})();
