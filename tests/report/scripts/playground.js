var box = document.querySelector('.live'), found = {};
function pick(select, text) {
  var list = Array.prototype.slice.call(select.options);
  select.value = list.find(function (o) { return o.textContent === text; }).value;
  select.dispatchEvent(new Event('change'));
}
var selects = box.querySelectorAll('select');
var numbers = box.querySelectorAll('.bar input[type=number]');
found.stacks = Array.prototype.map.call(selects[0].options, function (o) {
  return o.textContent; });
found.switches = Array.prototype.map.call(box.querySelectorAll('.switch'), function (s) {
  return s.childNodes[1].textContent; });
found.plain = box.querySelector('output').textContent;
pick(selects[1], 'sine');
numbers[4].value = '300'; numbers[4].dispatchEvent(new Event('input'));
box.querySelector('.switch input').click();
setTimeout(function () {
  found.effect = box.querySelector('output').textContent;
  found.values = box.psa.values.slice();
  found.csv = box.psa.csv();
  numbers[1].value = '900'; numbers[1].dispatchEvent(new Event('input'));
  box.psa.csv();
  found.beyond = box.querySelector('.warnings').textContent;
  numbers[1].value = '-120'; numbers[1].dispatchEvent(new Event('input'));
  box.psa.csv();
  found.within = box.querySelector('.warnings').hidden;
  numbers[1].value = '120'; numbers[1].dispatchEvent(new Event('input'));
  found.file = box.psa.file();
  found.knobs = Array.prototype.filter.call(box.querySelectorAll('.knob'), function (k) {
    return !k.hidden && !k.closest('details'); }).length;
  pick(selects[0], 'PTBS200');
  setTimeout(function () {
    found.other = box.querySelector('output').textContent;
    var plot = box.querySelector('.plot'), area = plot.getBoundingClientRect();
    [['pointerdown', 0.3], ['pointermove', 0.6]].forEach(function (row) {
      plot.dispatchEvent(new PointerEvent(row[0], {pointerId: 1, button: 0,
        clientX: area.left + row[1] * area.width, clientY: area.top + 0.5 * area.height}));
    });
    setTimeout(function () {
      found.drawn = box.querySelector('output').textContent;
      found.corners = psaLive.voltages.corners('0 0, 0.1 100; 0.2:50', 5).v;
      found.read = psaLive.voltages.read(
        'Zeit;t (ms);U [kV]\n1;0,0;0,1\n2;1,0;0,2\n3;2,0;0,3\n4;3,5;0,1\n');
      found.even = psaLive.voltages.read('t,v\n' + Array.from({length: 20}, function (_, k) {
        var t = k % 2 ? 1.01 * k : k;
        return t + ',' + 2 * t; }).join('\n'));
      found.none = [psaLive.voltages.corners('1 0, 0 5', 5), psaLive.voltages.read('a,b\n1,2\n')];
      found.spent = box.psa.last();
      var knob = Array.prototype.find.call(box.querySelectorAll('.knob'), function (k) {
        return k.querySelector('label').textContent === 'tau'; }).querySelector('[type=range]');
      knob.value = '650'; knob.dispatchEvent(new Event('input'));
      found.chosen = box.psa.file();
      var create = URL.createObjectURL;
      URL.createObjectURL = function (blob) {
        var reader = new FileReader();
        reader.onload = function () { found.fmu = reader.result.split(',')[1]; tell(found); };
        reader.readAsDataURL(blob);
        return create.call(URL, blob);
      };
      Array.prototype.find.call(box.querySelectorAll('button'), function (b) {
        return b.textContent === 'Download FMU'; }).click();
    }, 400);
  }, 400);
}, 400);
