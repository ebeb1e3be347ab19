// What all scripts of the page share: elements made of text alone, never of markup.
var desk = {setup: JSON.parse(document.getElementById('page-data').textContent)};

desk.el = function (id) { return document.getElementById(id); };

// desk.make('li', {className: 'name'}, 'text', node, ...)
desk.make = function (tag, given) {
  'use strict';
  var node = document.createElement(tag);
  Object.keys(given || {}).forEach(function (key) { node[key] = given[key]; });
  Array.prototype.slice.call(arguments, 2).forEach(function (part) { node.append(part); });
  return node;
};

desk.svg = function (tag, given) {
  'use strict';
  var node = document.createElementNS('http://www.w3.org/2000/svg', tag);
  Object.keys(given).forEach(function (key) { node.setAttribute(key, given[key]); });
  return node;
};

desk.words = function (name) { return name.replace(/_/g, ' '); };

desk.length = function (metres) {
  'use strict';
  var unit = [[1e-3, 'mm'], [1e-6, 'µm'], [1e-9, 'nm']].find(function (u) { return Math.abs(metres) >= u[0]; }) || [1e-12, 'pm'];
  return +(metres / unit[0]).toPrecision(3) + ' ' + unit[1];
};

// A length in the unit that reads best; any other quantity in the one that it has.
desk.amount = function (value, unit) {
  'use strict';
  return unit === 'm' ? desk.length(value) : +value.toPrecision(3) + (unit && unit !== '1' ? ' ' + unit : '');
};

desk.size = function (bytes) {
  'use strict';
  return bytes < 1e6 ? Math.max(1, Math.round(bytes / 1e3)) + ' kB' : (bytes / 1e6).toFixed(1) + ' MB';
};

// A part is made anew only where what it shows has changed, and what had the focus keeps it.
desk.filled = function (box, key, make) {
  'use strict';
  if (box.shown === key) { return; }
  box.shown = key;
  var own = document.activeElement && box.contains(document.activeElement) ? document.activeElement.id : '';
  box.replaceChildren.apply(box, make());
  if (own && desk.el(own)) { desk.el(own).focus(); }
};

desk.post = function (path, given) {
  'use strict';
  return fetch(path, {method: 'POST', headers: {'Content-Type': 'application/json'}, body: JSON.stringify(given || {})})
    .then(desk.answered);
};

desk.answered = function (answer) {
  'use strict';
  return answer.text().then(function (text) {
    desk.el('refused').hidden = answer.ok;
    desk.el('refused').textContent = answer.ok ? '' : text;
    return desk.look();
  });
};
