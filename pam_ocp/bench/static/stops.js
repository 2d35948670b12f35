// Stops on the stroke (up and down) and on the time axis (left and right), dragged by pointer or
// moved by arrow keys. "slide" while they move (one message at a time: the next is sent when the
// page has shown the last), "settle" when they are let go. Values in SI; shown times "factor".
const M = { left: 62, right: 14, top: 12, bottom: 38 };
function ticks(low, high, most) {
  const raw = (high - low) / Math.max(1, most), power = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999) || 10 * power;
  const found = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) found.push(Math.abs(v) < 1e-12 * step ? 0 : v);
  return found.map((v) => ({ v, text: String(Number(v.toPrecision(6))) }));
}
export default {
  template: `
    <div class="bench-stops" ref="box">
      <svg :width="width" :height="height" role="group" :aria-label="label" ref="svg"
        @pointermove="move" @pointerup="drop" @pointercancel="drop" @dblclick="add">
        <rect class="stops-paper" :x="M.left" :y="M.top" :width="w" :height="h" />
        <g v-for="k in xTicks"><line class="stops-grid" :x1="X(k.v / tf)" :x2="X(k.v / tf)" :y1="M.top" :y2="M.top + h" />
          <text class="stops-text" :x="X(k.v / tf)" :y="M.top + h + 15" text-anchor="middle">{{ k.text }}</text></g>
        <g v-for="k in yTicks"><line class="stops-grid" :x1="M.left" :x2="M.left + w" :y1="Y(k.v * factor)" :y2="Y(k.v * factor)" />
          <text class="stops-text" :x="M.left - 6" :y="Y(k.v * factor) + 4" text-anchor="end">{{ k.text }}</text></g>
        <text class="stops-text" :x="M.left + w / 2" :y="294" text-anchor="middle">time [{{ timeUnit }}]</text>
        <text class="stops-text" :transform="'rotate(-90)'" :x="-(M.top + h / 2)" y="14" text-anchor="middle">{{ unit ? variable + ' [' + unit + ']' : variable }}</text>
        <g v-for="(a, i) in active" role="img" :aria-label="a.label + ' is active'">
          <text class="stops-text" :x="M.left" :y="300 + 11 + 24 * i">{{ a.label }}</text>
          <line class="stops-grid" :x1="M.left" :x2="M.left + w" :y1="300 + 18.5 + 24 * i" :y2="300 + 18.5 + 24 * i" />
          <rect v-for="p in a.spans" class="stops-active" :x="X(p[0])" :width="Math.max(3, X(p[1]) - X(p[0]))" :y="300 + 15 + 24 * i" height="7" /></g>
        <g v-for="b in bounds"><rect class="stops-beyond" :x="M.left" :y="b.y" :width="w" :height="b.h" />
          <line class="stops-bound" :x1="M.left" :x2="M.left + w" :y1="b.line" :y2="b.line" /></g>
        <polyline v-for="o in others" class="stops-other" :points="path(o)" :style="{ stroke: o.colour, strokeDasharray: o.dash }" />
        <polyline v-if="record" class="stops-record" :points="path(record)" />
        <polyline v-if="curve" :class="pending ? 'stops-old' : 'stops-curve'" :points="path(curve)" />
        <g v-for="(s, i) in shown" :key="i" class="stops-stop" :class="{ 'is-wrong': wrong === i, 'is-held': held === i }"
          tabindex="0" role="slider" aria-orientation="vertical" :aria-valuenow="Number((s.at / factor).toPrecision(5))"
          :aria-valuemin="low / factor" :aria-valuemax="high / factor" :aria-label="name(i)" :aria-valuetext="words(s)"
          @pointerdown="take($event, i)" @keydown="key($event, i)" @keyup="keyUp($event)">
          <line v-if="s.fixed" class="stops-time" :x1="X(s.t)" :x2="X(s.t)" :y1="Y(s.at)" :y2="M.top + h" />
          <rect v-if="s.dwell > 0" class="stops-dwell" :x="X(s.t)" :y="Y(s.at) - 3" :width="Math.max(0, X(s.t + s.dwell) - X(s.t))" height="6" />
          <circle :cx="X(s.t)" :cy="Y(s.at)" r="14" class="stops-grip" />
          <circle v-if="s.rest" :cx="X(s.t)" :cy="Y(s.at)" r="7" class="stops-dot" />
          <rect v-else :x="X(s.t) - 6" :y="Y(s.at) - 6" width="12" height="12" class="stops-dot" :transform="'rotate(45 ' + X(s.t) + ' ' + Y(s.at) + ')'" />
          <text class="stops-label" :x="X(s.t) + (s.t > 0.8 * span ? -12 : 12)" :y="Y(s.at) + (Y(s.at) < M.top + 24 ? 20 : -10)"
            :text-anchor="s.t > 0.8 * span ? 'end' : 'start'">{{ words(s) }}</text>
        </g>
        <text v-if="problem && wrong != null && shown[wrong]" class="stops-problem" :x="Math.min(X(shown[wrong].t) + 14, M.left + w - 6)"
          :y="Math.min(Y(shown[wrong].at) + 22, M.top + h - 6)" :text-anchor="shown[wrong].t > 0.5 * span ? 'end' : 'start'">{{ problem }}</text>
      </svg>
    </div>`,
  props: {
    stops: Array, variable: String, unit: String, factor: Number, low: Number, high: Number, curve: Object,
    others: Array, record: Object, pending: Boolean, duration: Number, wrong: Number, problem: String, seen: Number, label: String, active: Array,
  },
  data() {
    return { M, width: 700, held: null, local: null, frozen: null, sent: 0, waits: null, at: 0 };
  },
  mounted() {
    this.watcher = new ResizeObserver(() => {
      const box = this.$refs.box;
      if (box && box.clientWidth) this.width = box.clientWidth;
    });
    this.watcher.observe(this.$refs.box);
  },
  unmounted() { this.watcher.disconnect(); },
  computed: {
    w() { return Math.max(50, this.width - M.left - M.right); },
    h() { return 300 - M.top - M.bottom; },
    height() { return 300 + 24 * (this.active || []).length; },
    ends() {
      const later = Math.max(0, ...(this.stops || []).map((s) => s.t + (s.dwell || 0)), ...(this.others || []).map((o) => o.t[o.t.length - 1] || 0));
      return Math.max(this.duration || 0, later) || 1;
    },
    span() { return this.frozen || 1.12 * this.ends; },
    tf() { return this.span < 2 ? 1000 : 1; },
    timeUnit() { return this.span < 2 ? "ms" : "s"; },
    pad() { return 0.1 * (this.high - this.low); },
    shown() { return this.local || this.stops || []; },
    xTicks() { return ticks(0, this.span * this.tf, this.w / 90); },
    yTicks() { return ticks((this.low - this.pad) / this.factor, (this.high + this.pad) / this.factor, this.h / 40); },
    bounds() {
      const top = this.Y(this.high), bottom = this.Y(this.low);
      return [{ y: M.top, h: Math.max(0, top - M.top), line: top }, { y: bottom, h: Math.max(0, M.top + this.h - bottom), line: bottom }];
    },
  },
  watch: {
    seen() {
      const next = this.waits;
      this.waits = null;
      if (next) this.send(next);
    },
    stops() { if (this.held == null) this.local = null; },
  },
  methods: {
    X(t) { return M.left + (t / this.span) * this.w; },
    Y(v) { return M.top + ((this.high + this.pad - v) / (this.high - this.low + 2 * this.pad)) * this.h; },
    path(c) { return c.t.map((t, i) => this.X(t).toFixed(1) + "," + this.Y(c.x[i]).toFixed(1)).join(" "); },
    name(i) { return "stop " + (i + 1) + ", " + this.variable; },
    words(s) {
      const at = Number((s.at / this.factor).toPrecision(4)) + " " + this.unit;
      return s.fixed ? at + " at " + Number((s.t * this.tf).toPrecision(4)) + " " + this.timeUnit : at;
    },
    place(event) {
      const r = this.$refs.svg.getBoundingClientRect();
      const t = ((event.clientX - r.left - M.left) / this.w) * this.span;
      const v = this.high + this.pad - ((event.clientY - r.top - M.top) / this.h) * (this.high - this.low + 2 * this.pad);
      return { t, v };
    },
    take(event, i) {
      event.preventDefault();
      event.currentTarget.focus();
      this.$refs.svg.setPointerCapture(event.pointerId);
      this.frozen = this.span;
      this.held = i;
      this.local = this.stops.map((s) => ({ ...s }));
      this.from = { x: event.clientX, y: event.clientY };
      this.timed = this.stops[i].fixed;
      this.moved = false;
    },
    move(event) {
      if (this.held == null || !this.from) return;
      const dx = Math.abs(event.clientX - this.from.x), dy = Math.abs(event.clientY - this.from.y);
      if (!this.moved && dx + dy < 3) return;
      this.moved = true;
      if (this.held > 0 && dx > 14 && dx > dy) this.timed = true;
      const p = this.place(event);
      this.set(this.held, p.v, this.timed && this.held > 0 ? p.t : null);
    },
    set(i, at, t) {
      const s = this.local[i], before = i > 0 ? this.local[i - 1] : null;
      s.at = Math.min(this.high, Math.max(this.low, at));
      if (t != null) {
        const least = before.t + (before.dwell || 0) + 0.002 * this.span, shift = Math.max(least, t) - s.t;
        for (let k = i; k < this.local.length; k++) this.local[k].t += shift;
        s.fixed = true;
      }
      const leg = s.fixed && before ? s.t - before.t - (before.dwell || 0) : null;
      const said = { stop: i, at: s.at, leg };
      this.last = said;
      if (this.sent > (this.seen || 0) && performance.now() - this.at < 1500) this.waits = said;
      else this.send(said);
    },
    send(said) { this.sent = (this.seen || 0) + 1; this.at = performance.now(); this.$emit("slide", said); },
    drop(event) {
      if (this.held == null) return;
      this.held = null; this.frozen = null; this.waits = null; this.from = null;
      if (this.moved) this.$emit("settle", this.last);
      else this.local = null;
      this.moved = false;
    },
    key(event, i) {
      const step = (event.shiftKey ? 0.1 : 0.01) * (this.high - this.low), later = (event.shiftKey ? 0.1 : 0.01) * this.span;
      const by = { ArrowUp: [step, 0], ArrowDown: [-step, 0], ArrowRight: [0, later], ArrowLeft: [0, -later] }[event.key];
      if (event.key === "Delete") { this.$emit("remove", { stop: i }); event.preventDefault(); return; }
      if (!by) return;
      event.preventDefault();
      if (!this.local) this.local = this.stops.map((s) => ({ ...s }));
      this.frozen = this.frozen || this.span;
      const s = this.local[i];
      this.set(i, s.at + by[0], by[1] && i > 0 ? s.t + by[1] : null);
      this.keyed = true;
    },
    keyUp(event) {
      if (this.keyed && event.key.startsWith("Arrow")) { this.keyed = false; this.frozen = null; this.waits = null; this.$emit("settle", this.last); }
    },
    add(event) {
      const p = this.place(event);
      if (p.t > 0 && p.t < this.span) this.$emit("add", { at: Math.min(this.high, Math.max(this.low, p.v)), t: p.t });
    },
  },
};
