// A stretch of time is chosen by dragging over a plot, or by keys; all plots over time show it.
psaLive.zoom = function (canvases, whole, changed) {
  'use strict';
  var zoom = {reach: null};

  function set(low, high) {
    var full = whole(), span = Math.min(high - low, full[1] - full[0]);
    var begin = Math.min(Math.max(low, full[0]), full[1] - span);
    zoom.reach = span >= 0.999 * (full[1] - full[0]) ? null : [begin, begin + span];
    changed();
  }

  function keys(event) {
    var now = zoom.reach || whole(), span = now[1] - now[0], middle = 0.5 * (now[0] + now[1]);
    var moves = {
      '+': [middle - 0.25 * span, middle + 0.25 * span], '-': [middle - span, middle + span],
      ArrowLeft: [now[0] - 0.2 * span, now[1] - 0.2 * span], ArrowRight: [now[0] + 0.2 * span, now[1] + 0.2 * span],
      '0': whole(), Escape: whole()
    };
    var wanted = moves[event.key === '=' ? '+' : event.key];
    if (!wanted || event.ctrlKey || event.metaKey) { return; }
    event.preventDefault();
    set(wanted[0], wanted[1]);
  }

  canvases.forEach(function (canvas) {
    var from = null, mark = null;
    function time(event) {
      var area = canvas.place.area, reach = canvas.place.reach.x;
      var part = (event.clientX - canvas.getBoundingClientRect().left - area.left) / area.width;
      return reach[0] + Math.min(1, Math.max(0, part)) * (reach[1] - reach[0]);
    }
    canvas.tabIndex = 0;
    canvas.title = 'Drag over a stretch to see it alone, double-click for all; keys: + - 0 and arrows.';
    canvas.addEventListener('keydown', keys);
    canvas.addEventListener('pointerdown', function (event) {
      if (event.button !== 0 || event.pointerType === 'touch') { return; } // a finger scrolls the page
      from = time(event);
      mark = psaLive.make('div', {className: 'marked'});
      canvas.parentNode.appendChild(mark);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener('pointermove', function (event) {
      if (from === null) { return; }
      var a = canvas.place.x(from), b = canvas.place.x(time(event));
      mark.style.left = canvas.offsetLeft + Math.min(a, b) + 'px';
      mark.style.top = canvas.offsetTop + canvas.place.area.top + 'px';
      mark.style.width = Math.abs(b - a) + 'px';
      mark.style.height = canvas.place.area.height + 'px';
    });
    function end(event) {
      if (from === null) { return; }
      var to = time(event), begin = from, now = zoom.reach || whole();
      from = null;
      mark.remove();
      if (event.type === 'pointerup' && Math.abs(to - begin) > 0.01 * (now[1] - now[0])) {
        set(Math.min(to, begin), Math.max(to, begin));
      }
    }
    canvas.addEventListener('pointerup', end);
    canvas.addEventListener('pointercancel', end);
    canvas.addEventListener('dblclick', function () { set(whole()[0], whole()[1]); });
  });
  zoom.forget = function () { zoom.reach = null; };
  return zoom;
};
