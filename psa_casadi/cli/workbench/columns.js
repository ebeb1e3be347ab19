// The first rows of the files, a choice for every column, and the text of --columns that it makes.
desk.columns = (function () {
  'use strict';
  var make = desk.make, units = desk.setup.columns;

  function parts(text) { return text.split(',').filter(function (part) { return part.trim(); }); }
  // The file that a part of --columns names, as b.csv@time=t:ms does; '' for all of them.
  function file(part) { var m = /^([^=]*)@/.exec(part); return m ? m[1].trim() : ''; }

  // What --columns says now of a file, by the name of the array: {column, unit, scale}.
  function wanted(text, stored) {
    var found = {}, all = parts(text), own = all.filter(function (p) { return file(p) === stored; });
    (own.length ? own : all.filter(function (p) { return !file(p); })).forEach(function (part) {
      if (/^\s*(?:[^=]*@)?table\s*=/.test(part)) { found['table='] = {column: '', table: part.split('=')[1].trim()}; return; }
      var m = /^\s*(?:[^=]*@)?([^=@]+)=([^:\[\]]+)(?::\s*([+-]?[\d.]+(?:[eE][+-]?\d+)?)?\s*(.*))?$/.exec(part);
      if (m) { found[m[2].trim()] = {column: m[1].trim(), scale: m[3] || '', unit: m[4] || ''}; }
    });
    return found;
  }

  function option(value, text, chosen) { return make('option', {value: value, selected: chosen}, text); }

  // The choices of one layout: what --columns says, else what the reader takes a column for.
  function choices(head, text, stored) {
    var said = wanted(text, stored), taken = Object.keys(said).map(function (n) { return said[n].column; });
    return head.names.map(function (name, k) {
      if (name && said[name]) { return said[name]; }
      var own = Object.keys(head.guess).find(function (c) { return head.guess[c][0] === k; });
      return own && taken.indexOf(own) < 0 ? {column: own, unit: head.guess[own][1], scale: ''} : {column: '', unit: '', scale: ''};
    });
  }

  // A unit that differs from the one in the header needs a number: what 1 in the file is.
  function line(head, chosen) {
    var found = [];
    chosen.forEach(function (c, k) {
      if (!c.column || !head.names[k]) { return; }
      var scale = c.scale || (head.units[k] && head.units[k] !== c.unit ? '1' : '');
      found.push(c.column + '=' + head.names[k] + ':' + scale + c.unit);
    });
    return found;
  }

  // Files of one layout share what is said; of several layouts, each part names its file.
  function apply(layout, chosen) {
    var own = (layout.table ? ['table=' + layout.table] : []).concat(line(layout.head, chosen)), all = own;
    if (layout.others) {
      all = parts(layout.text).filter(function (p) { return layout.stored.indexOf(file(p)) < 0; });
      layout.stored.forEach(function (name) { all = all.concat(own.map(function (p) { return name + '@' + p; })); });
    }
    return desk.post('/settings', {columns: all.join(',')});
  }

  function cell(layout, chosen, k, id) {
    var head = layout.head;
    var own = chosen[k], name = head.names[k];
    var what = make('select', {id: id + 'c' + k, disabled: !name, ariaLabel: 'Column ' + (name || k + 1) + ' is'});
    what.append(option('', 'not used', !own.column));
    Object.keys(units).forEach(function (c) { what.append(option(c, desk.words(c), c === own.column)); });
    var unit = make('select', {id: id + 'u' + k, disabled: !own.column || !name, ariaLabel: 'Unit of ' + (name || k + 1)});
    var listed = units[own.column] || [];
    if (own.unit && listed.indexOf(own.unit) < 0) { listed = [own.unit].concat(listed); }
    listed.forEach(function (u) { unit.append(option(u, u, u === own.unit)); });
    var scale = make('input', {id: id + 's' + k, value: own.scale, inputMode: 'decimal', disabled: unit.disabled,
      placeholder: '1 is ...', ariaLabel: '1 in ' + (name || k + 1) + ' is so many of the unit', autocomplete: 'off'});
    what.onchange = function () {
      chosen.forEach(function (c) { if (what.value && c.column === what.value) { c.column = ''; } });
      own = chosen[k] = {column: what.value, scale: '', unit: what.value ? head.units[k] : ''};
      var fits = units[what.value] || [];
      if (what.value && fits.indexOf(own.unit) < 0) { own.unit = what.value === 'displacement' ? 'um' : fits.find(function (u) { return /^(s|V|N|A|K|C|m|1)$/.test(u); }) || fits[0]; }
      apply(layout, chosen);
    };
    unit.onchange = function () { own.unit = unit.value; apply(layout, chosen); };
    scale.onchange = function () { own.scale = scale.value.trim(); apply(layout, chosen); };
    return make('td', {}, what, unit, scale);
  }

  // Which of several tables of the files is read; another one has other columns.
  function which(layout, id) {
    var one = make('select', {id: id + 'table', ariaLabel: 'Table of ' + layout.names.join(', ')});
    [''].concat(layout.head.tables, ['all']).forEach(function (name) {
      one.append(option(name, name === 'all' ? 'all, each a record' : name || 'which table?', name === layout.table));
    });
    one.onchange = function () { layout.table = one.value; apply(layout, []); };
    return one;
  }

  function table(layout, id) {
    var said = wanted(layout.text, layout.stored[0])['table='];
    layout.table = said ? said.table : '';
    var head = layout.head, chosen = choices(head, layout.text, layout.stored[0]), row = make('tr'), top = make('tr'), body = make('tbody');
    head.names.forEach(function (name, k) {
      top.append(make('th', {scope: 'col'}, (name || 'a name with a mark of --columns') + (head.units[k] ? ' [' + head.units[k] + ']' : '')));
      row.append(cell(layout, chosen, k, id));
    });
    body.append(row);
    head.rows.forEach(function (cells) {
      var line = make('tr');
      cells.forEach(function (text) { line.append(make('td', {className: 'figure'}, text)); });
      body.append(line);
    });
    var use = make('button', {type: 'button', id: id + 'use'}, 'Read with these columns');
    use.onclick = function () { apply(layout, chosen); };
    return make('div', {}, make('p', {className: 'note'}, layout.names.join(', ') + ' ', head.tables.length ? which(layout, id) : ''),
      make('div', {className: 'scroll', tabIndex: 0, role: 'region', ariaLabel: 'First rows'},
        make('table', {className: 'mapping'}, make('thead', {}, top), body)), use);
  }

  function record(item) {
    var r = item.seen.record, more = r.others.length ? '; also ' + r.others.map(desk.words).join(', ') : '';
    var reached = Object.keys(r.reached).map(function (name) {
      var own = r.reached[name];
      return ', ' + desk.words(name) + ' ' + desk.amount(own[0], own[2]) + ' to ' + desk.amount(own[1], own[2]);
    }).join('');
    return make('figure', {}, make('figcaption', {}, item.name),
      make('p', {className: 'note'}, r.n + ' samples in ' + +r.seconds.toPrecision(4) + ' s' + reached + more),
      make('img', {className: 'still', src: 'data:image/png;base64,' + r.picture, alt: item.name + ': ' + r.alt}));
  }

  return function (items, text) {
    var layouts = {}, seen = items.filter(function (i) { return i.seen && i.seen.head; });
    seen.forEach(function (i) {
      var key = JSON.stringify([i.seen.head.names, i.seen.head.units, i.seen.head.tables]);
      layouts[key] = layouts[key] || {head: i.seen.head, names: [], stored: [], text: text};
      layouts[key].names.push(i.name);
      layouts[key].stored.push(i.stored);
    });
    desk.filled(desk.el('columns'), JSON.stringify([layouts, text]), function () {
      var keys = Object.keys(layouts);
      if (!keys.length) { return [make('p', {className: 'note'}, 'No record yet.')]; }
      return keys.map(function (key, k) {
        layouts[key].others = keys.length > 1;
        return table(layouts[key], 'layout' + k);
      });
    });
    var drawn = items.filter(function (i) { return i.seen && i.seen.record; });
    desk.filled(desk.el('curves'), JSON.stringify(drawn.map(function (i) { return [i.key, i.name, i.seen.record]; })), function () {
      return drawn.map(record);
    });
  };
})();
