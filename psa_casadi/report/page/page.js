// What all plots of a page share: the library, colours by day and night. Draws those that stand still.
var psaPage = (function () {
  'use strict';
  var scheme = window.matchMedia('(prefers-color-scheme: dark)');
  var finger = window.matchMedia('(pointer: coarse)').matches;
  var boxes = Array.prototype.slice.call(document.querySelectorAll('.drawing'));
  var config = {responsive: true, displaylogo: false, displayModeBar: false}, dark, arrays;
  if (!psaPacked.able) { // the still picture stays
    return {ready: Promise.reject(new Error('it is older than 2023')), finger: finger};
  }
  dark = JSON.parse(document.getElementById('dark-colours').textContent);
  document.documentElement.classList.add('scripted');

  // every colour of a figure is written for paper; at night each has a counterpart
  function painted(part, night) {
    if (typeof part === 'string') {
      return night && Object.prototype.hasOwnProperty.call(dark, part) ? dark[part] : part;
    }
    if (Array.isArray(part)) {
      return part.map(function (p) { return painted(p, night); });
    }
    if (part === null || typeof part !== 'object') { return part; }
    if ('bdata' in part) { // a number stands for an array that several curves share
      return typeof part.bdata === 'number' ? Object.assign({}, part, {bdata: arrays[part.bdata]}) : part;
    }
    var copy = {};
    Object.keys(part).forEach(function (key) { copy[key] = painted(part[key], night); });
    return copy;
  }

  function draw(box, night, width) {
    var figure = painted(JSON.parse(box.previousElementSibling.textContent), night);
    var layout = figure.layout;
    layout.template = {}; // all is said in the figure itself
    if (width) {
      layout.width = width;
      layout.autosize = false;
    }
    var room = width || box.clientWidth;
    if (layout.meta && layout.meta.square) { layout.height = Math.min(layout.height, room + 30); }
    box.style.height = layout.height + 'px'; // else a window that turns and darkens at once leaves none
    if (room < 480) {
      layout.font.size = 11;
      layout.margin.l = Math.min(layout.margin.l, 52);
    }
    // a finger scrolls the page over a plot instead of zooming it
    if (finger) { layout.dragmode = false; }
    return Plotly.react(box, figure.data, layout, config);
  }

  function all(night, printing) {
    boxes.forEach(function (box) {
      var half = box.closest('.pair') !== null;
      draw(box, night, printing ? (half ? 330 : 680) : 0);
    });
  }

  var ready = Promise.all(['arrays', 'library'].map(function (name) {
    return psaPacked.text(document.getElementById(name).textContent);
  })).then(function (found) {
    arrays = found[0].split(' ');
    var script = document.createElement('script');
    script.textContent = found[1];
    document.head.appendChild(script);
    all(scheme.matches, false);
    scheme.addEventListener('change', function () { all(scheme.matches, false); });
    window.addEventListener('beforeprint', function () {
      document.querySelectorAll('details').forEach(function (fold) { fold.open = true; }); // paper has no folds
      all(false, true);
    });
    window.addEventListener('afterprint', function () { all(scheme.matches, false); });
  });
  ready.catch(function () { document.documentElement.classList.remove('scripted'); });
  return {ready: ready, finger: finger};
})();
