var box = document.querySelector('.live'), found = {};
function text() { return box.querySelector('output').textContent; }
function drawn() { return JSON.stringify(box.querySelector('.plot').data.map(function (t) {
  return Array.from(t.y); })); }
function row() { return Array.prototype.map.call(box.querySelectorAll('.budget td'), function (c) {
  return c.textContent; }); }
function knob(name) { return Array.prototype.find.call(box.querySelectorAll('.knob'), function (k) {
  return k.querySelector('label').textContent === name; }); }
found.first = text(); found.picture = drawn();
found.fitted = row();
var apart = document.createElement('div');
psaLive.budget(apart, [['worse', 1e-9], ['better', 2e-6]], 1e-6, 0, String);
found.cut = Array.prototype.map.call(apart.querySelectorAll('tr td:last-child'), function (c) {
  return c.textContent; });
var range = knob('k_L').querySelector('input[type=range]');
range.value = '620'; range.dispatchEvent(new Event('input'));
setTimeout(function () {
  found.moved = text(); found.changed = drawn() !== found.picture;
  found.values = box.psa.values.slice(); found.file = box.psa.file();
  var number = knob('tau').querySelector('input[type=number]');
  number.value = '0.25'; number.dispatchEvent(new Event('change'));
  box.querySelector('.switch input').click();
  setTimeout(function () {
    found.budget = row(); found.switched = text(); found.then = box.psa.values.slice();
    Array.prototype.find.call(box.querySelectorAll('button'), function (b) {
      return b.textContent === 'Reset'; }).click();
    setTimeout(function () {
      found.reset = text(); found.again = drawn() === found.picture;
      var plot = box.querySelector('.plot');
      plot.dispatchEvent(new KeyboardEvent('keydown', {key: '+'}));
      setTimeout(function () {
        found.reach = plot.layout.xaxis.range;
        found.images = document.querySelectorAll('img:not(.still)').length;
        found.options = Array.prototype.map.call(box.querySelectorAll('option'), function (o) {
          return o.textContent; });
        found.spent = box.psa.last();
        tell(found);
      }, 300);
    }, 300);
  }, 600);
}, 300);
