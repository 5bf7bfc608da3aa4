// What the page says, in each language: the browser's first one that is here, else English. A row
// is a key with English, German and Chinese; {name} is a value, and where n is not 1 what stands
// after a bar is said. What the server says itself is English.
const LANGUAGES = ['en', 'de', 'zh'];
const TABLE = {
  skip: ['To the scene', 'Zur Szene', '跳到场景'],
  view: ['The scene in 3D', 'Die Szene in 3D', '三维场景'],
  name: ['Name of this scene', 'Name dieser Szene', '场景名称'],
  nameless: ['(no name)', '(ohne Namen)', '（无名称）'],
  theme: ['Dark or light', 'Dunkel oder hell', '深色或浅色'],
  tools: ['View and files', 'Ansicht und Dateien', '视图与文件'],
  close: ['Close', 'Schließen', '关闭'],
  copy: ['Copy', 'Kopieren', '复制'],
  cancel: ['Cancel', 'Abbrechen', '取消'],
  more: ['More', 'Mehr', '更多'],
  progress: ['Progress', 'Fortschritt', '进度'],

  // Ways in.
  begin: [
    'Photos in, a scene in 3D out.',
    'Fotos hinein, eine 3D-Szene heraus.',
    '照片进，三维场景出。',
  ],
  'begin.more': [
    'Fly through it, and ask where things are.',
    'Fliegen Sie hindurch und fragen Sie, wo Dinge sind.',
    '在其中飞行，并询问物体在哪里。',
  ],
  drop: ['Drop anything here', 'Legen Sie hier alles ab', '把任何内容拖到这里'],
  'drop.more': [
    'photos, alone or with their cameras; a video; the folder of a capture (COLMAP, Polycam, ' +
      'Record3D and others), or one zip; or a file of Gaussians',
    'Fotos, allein oder mit ihren Kameras; ein Video; den Ordner einer Aufnahme (COLMAP, ' +
      'Polycam, Record3D und andere) oder ein Zip; oder eine Datei mit Gauß-Splats',
    '照片（可附相机参数）；视频；采集文件夹（COLMAP、Polycam、Record3D 等）或一个 zip；或高斯文件',
  ],
  files: ['Choose files', 'Dateien wählen', '选择文件'],
  folder: ['Choose a folder', 'Ordner wählen', '选择文件夹'],
  sample: ['Try the sample', 'Beispiel ausprobieren', '试用示例'],
  'sample.name': ['Sample', 'Beispiel', '示例'],
  'sample.comes': ['fetching the sample …', 'das Beispiel wird geholt …', '正在获取示例…'],
  join: [
    'Add to the scene that is shown',
    'Zur gezeigten Szene hinzufügen',
    '添加到当前场景',
  ],
  joined: [
    '{n} photo joined: {shown}|{n} photos joined: {shown}',
    '{n} Foto kam dazu: {shown}|{n} Fotos kamen dazu: {shown}',
    '已添加 {n} 张照片：{shown}',
  ],
  ignore: ['Leave out', 'Weglassen', '忽略'],
  'ignore.example': ['such as person, car', 'etwa person, car', '例如 person, car'],
  'ignore.title': [
    'Words of what must not become part of the scene, with commas between them',
    'Wörter (englisch) für das, was nicht in die Szene soll, mit Kommas dazwischen',
    '不应进入场景的物体名称（英文），以逗号分隔',
  ],
  leave: ['Take this photo out', 'Dieses Foto entfernen', '移除这张照片'],
  'leave.ask': ['Take {name} out?', '{name} entfernen?', '移除 {name}？'],
  'leave.what': [
    'What only this photo shows goes with it.',
    'Was nur dieses Foto zeigt, geht mit ihm.',
    '仅由这张照片呈现的内容将随之消失。',
  ],
  'leave.ever': [
    'To have it back, add its file again.',
    'Wer es wiederhaben will, fügt seine Datei wieder hinzu.',
    '如需恢复，请重新添加该文件。',
  ],
  'leave.yes': ['Take it out', 'Entfernen', '移除'],
  'left.photos': [
    '{n} photo was taken out: {shown}|{n} photos were taken out: {shown}',
    '{n} Foto wurde entfernt: {shown}|{n} Fotos wurden entfernt: {shown}',
    '已移除 {n} 张照片：{shown}',
  ],
  'photos.sent': ['Photos of this capture', 'Fotos dieser Aufnahme', '本次采集的照片'],
  key: ['Key of this server', 'Schlüssel dieses Servers', '服务器密钥'],
  'key.use': ['Use it', 'Verwenden', '使用'],
  choose: [
    'Drop photos, or choose a scene.',
    'Legen Sie Fotos ab oder wählen Sie eine Szene.',
    '拖入照片，或选择一个场景。',
  ],
  reading: ['looking at the files …', 'die Dateien werden gelesen …', '正在查看文件…'],
  sending: ['sending …', 'wird gesendet …', '正在发送…'],
  'not.sent': ['Nothing was sent.', 'Nichts wurde gesendet.', '没有发送任何内容。'],
  'photos.wrong': [
    '{n} photo is wrong; nothing was sent.|{n} photos are wrong; nothing was sent.',
    '{n} Foto ist fehlerhaft; nichts wurde gesendet.|{n} Fotos sind fehlerhaft; nichts wurde ' +
      'gesendet.',
    '{n} 张照片有误；没有发送任何内容。',
  ],
  'video.looking': [
    'looking at the video: {percent} % …',
    'das Video wird angesehen: {percent} % …',
    '正在查看视频：{percent} %…',
  ],
  'video.taking': [
    'taking frame {i} of {all} …',
    'Bild {i} von {all} wird entnommen …',
    '正在提取第 {i} / {all} 帧…',
  ],
  'video.taken': [
    '{n} frames of {name}: the sharpest, spread over the motion of the camera.',
    '{n} Bilder aus {name}: die schärfsten, verteilt über die Bewegung der Kamera.',
    '从 {name} 取 {n} 帧：最清晰的，按相机运动均匀分布。',
  ],
  'video.unread': [
    '{name}: this browser cannot play it. Save it as MP4 (H.264) or WebM, or give its frames.',
    '{name}: Dieser Browser kann es nicht abspielen. Speichern Sie es als MP4 (H.264) oder WebM, ' +
      'oder geben Sie seine Bilder.',
    '{name}：浏览器无法播放。请另存为 MP4（H.264）或 WebM，或提供其画面。',
  ],
  'photos.none': [
    'No photos: add PNG, JPEG or WebP files.',
    'Keine Fotos: fügen Sie PNG-, JPEG- oder WebP-Dateien hinzu.',
    '没有照片：请添加 PNG、JPEG 或 WebP 文件。',
  ],
  'photos.one': [
    'One photo: a scene needs two or more.',
    'Ein Foto: eine Szene braucht zwei oder mehr.',
    '只有一张照片：场景需要两张或更多。',
  ],
  'photos.chosen': [
    '{all} photos have {size}; {sent} are sent, evenly chosen: a scene takes no more.',
    '{all} Fotos haben {size}; {sent} werden gesendet, gleichmäßig gewählt: mehr nimmt eine ' +
      'Szene nicht.',
    '{all} 张照片共 {size}；均匀选取 {sent} 张发送：一个场景最多容纳这些。',
  ],
  'cameras.none': [
    'No cameras: the server finds them from the photos.',
    'Keine Kameras: der Server findet sie aus den Fotos.',
    '没有相机参数：服务器会从照片中求解。',
  ],
  'cameras.left': [
    '{lost} of {all} cameras have no photo here, as {first}: they are left out.',
    '{lost} von {all} Kameras haben hier kein Foto, etwa {first}: sie bleiben weg.',
    '{all} 个相机中有 {lost} 个没有对应照片（如 {first}）：已略去。',
  ],
  'cameras.lost': [
    '{lost} of {all} cameras have no photo here; the first is {first}.',
    '{lost} von {all} Kameras haben hier kein Foto; die erste ist {first}.',
    '{all} 个相机中有 {lost} 个没有对应照片；第一个是 {first}。',
  ],
  'frames.none': [
    'it has no list "frames"',
    'sie hat keine Liste „frames“',
    '其中没有 "frames" 列表',
  ],
  'and.more': ['and {count} more', 'und {count} weitere', '及另外 {count} 个'],
  unread: [
    '{files}: {kind} is a format that is not read; export it as JPEG (iPhone: Settings, Camera, ' +
      'Formats, Most Compatible; a Mac: Preview, Export).',
    '{files}: {kind} wird nicht gelesen; exportieren Sie es als JPEG (iPhone: Einstellungen, ' +
      'Kamera, Formate, Maximale Kompatibilität; Mac: Vorschau, Exportieren).',
    '{files}：不支持 {kind} 格式；请导出为 JPEG（iPhone：设置、相机、格式、兼容性最佳；' +
      'Mac：预览、导出）。',
  ],
  'row.photo': ['no photo; it is left out', 'kein Foto; bleibt weg', '没有照片；已略去'],
  'row.camera': ['no camera; it is left out', 'keine Kamera; bleibt weg', '没有相机；已略去'],
  'row.pose': [
    'its pose is not a 4 by 4 matrix of numbers',
    'seine Pose ist keine 4×4-Matrix aus Zahlen',
    '其位姿不是 4×4 数字矩阵',
  ],
  'row.picture': [
    'it cannot be read as a picture',
    'es ist als Bild nicht lesbar',
    '无法作为图片读取',
  ],
  shrinking: [
    'making photos smaller: {i} of {all}',
    'Fotos werden verkleinert: {i} von {all}',
    '正在缩小照片：{i} / {all}',
  ],
  shrunk: [
    '{n} photo was made smaller before sending, to what the server keeps of a photo: {before} ' +
      'became {after}.|{n} photos were made smaller before sending, to what the server keeps of ' +
      'a photo: {before} became {after}.',
    '{n} Foto wurde vor dem Senden verkleinert, auf das, was der Server behält: aus {before} ' +
      'wurden {after}.|{n} Fotos wurden vor dem Senden verkleinert, auf das, was der Server ' +
      'behält: aus {before} wurden {after}.',
    '发送前已将 {n} 张照片缩小到服务器保留的尺寸：{before} 变为 {after}。',
  ],

  // Scenes.
  scenes: ['Scenes', 'Szenen', '场景'],
  'scenes.none': ['None yet.', 'Noch keine.', '还没有。'],
  'scene.is': ['the scene is {state}', 'die Szene ist {state}', '场景状态：{state}'],
  'scene.short': ['the scene ended early', 'die Szene brach ab', '场景数据不完整'],
  'title.photos': ['{n} photo|{n} photos', '{n} Foto|{n} Fotos', '{n} 张照片'],
  'title.file': ['A file ({format})', 'Eine Datei ({format})', '文件（{format}）'],
  queued: ['waiting', 'wartet', '等待中'],
  running: ['being made', 'in Arbeit', '生成中'],
  failed: ['failed', 'fehlgeschlagen', '失败'],
  cancelled: ['cancelled', 'abgebrochen', '已取消'],
  loading: ['loading the scene …', 'die Szene wird geladen …', '正在加载场景…'],
  gaussians: ['{n} Gaussians', '{n} Gauß-Splats', '{n} 个高斯'],
  'gaussians.some': [
    'The {n} largest of {all} Gaussians: more have no room here',
    'Die {n} größten von {all} Gauß-Splats: für mehr ist hier kein Platz',
    '{all} 个高斯中最大的 {n} 个：此设备容不下更多',
  ],
  'gaussians.coarse': [
    '{all} Gaussians, some of them merged: there is room for {n} here',
    '{all} Gauß-Splats, zum Teil zusammengefasst: hier ist Platz für {n}',
    '{all} 个高斯，其中一部分合并显示：此处最多容纳 {n} 个',
  ],
  ahead: ['waiting, {n} ahead', 'wartet, {n} davor', '等待中，前面还有 {n} 个'],
  left: ['about {time} left', 'noch etwa {time}', '约剩 {time}'],
  seconds: ['{n} s', '{n} s', '{n} 秒'],
  minutes: ['{n} min', '{n} min', '{n} 分钟'],
  'stage.photos': ['reading the photos', 'Fotos werden gelesen', '读取照片'],
  'stage.cameras': ['finding the cameras', 'Kameras werden gesucht', '求解相机'],
  'stage.capture': ['checking the cameras', 'Kameras werden geprüft', '检查相机'],
  'stage.geometry': ['finding the shapes', 'Formen werden gesucht', '重建形状'],
  'stage.lift': ['making Gaussians', 'Gauß-Splats entstehen', '生成高斯'],
  'stage.store': ['storing', 'wird gespeichert', '存储'],
  'stage.masks': ['finding things', 'Dinge werden gesucht', '寻找物体'],
  'stage.embed': ['finding out what they are', 'Dinge werden benannt', '识别物体'],
  'stage.bank': ['joining what is alike', 'Gleiches wird verbunden', '合并相同物体'],
  'stage.assign': ['marking the Gaussians', 'Gauß-Splats werden markiert', '标记高斯'],
  delete: ['Delete scene {name}', 'Szene {name} löschen', '删除场景 {name}'],
  'delete.ask': ['Delete scene {name}?', 'Szene {name} löschen?', '删除场景 {name}？'],
  'delete.what': [
    'The server removes its photos, its Gaussians and what was found in it. Links to it stop ' +
      'working.',
    'Der Server entfernt ihre Fotos, ihre Gauß-Splats und was darin gefunden wurde. Links zu ihr ' +
      'gehen nicht mehr.',
    '服务器会移除其照片、高斯和其中找到的内容。指向它的链接将失效。',
  ],
  'delete.ever': [
    'This cannot be undone.',
    'Das kann nicht rückgängig gemacht werden.',
    '此操作无法撤销。',
  ],
  'delete.no': ['Keep it', 'Behalten', '保留'],
  'delete.yes': ['Delete for ever', 'Endgültig löschen', '永久删除'],
  deleted: ['Scene {name} is deleted.', 'Die Szene {name} ist gelöscht.', '场景 {name} 已删除。'],

  // Words and clicks.
  'ask.label': ['Where is', 'Wo ist', '在哪里'],
  'ask.example': ['Where is … a red chair?', 'Wo ist … a red chair?', '在哪里… a red chair?'],
  'ask.find': ['Find', 'Finden', '查找'],
  words: ['Words that are shown', 'Gezeigte Wörter', '显示的词'],
  looking: ['looking …', 'wird gesucht …', '正在查找…'],
  found: [
    '{gaussians} Gaussians in {n} part|{gaussians} Gaussians in {n} parts',
    '{gaussians} Gauß-Splats in {n} Teil|{gaussians} Gauß-Splats in {n} Teilen',
    '{n} 处共 {gaussians} 个高斯',
  ],
  'found.not': [
    'not found, the best score is {score}',
    'nicht gefunden, der beste Wert ist {score}',
    '未找到，最高得分为 {score}',
  ],
  'found.nothing': ['not found', 'nicht gefunden', '未找到'],
  'score.title': [
    'The best relevancy of anything in the scene; from 0.5 on it is found',
    'Die beste Übereinstimmung in der Szene; ab 0,5 gilt es als gefunden',
    '场景中的最高相关度；达到 0.5 即视为找到',
  ],
  good: ['known well', 'gut bekannt', '熟悉'],
  fair: ['known fairly', 'leidlich bekannt', '较熟悉'],
  poor: ['known poorly', 'schlecht bekannt', '不熟悉'],
  unmeasured: ['not measured', 'nicht gemessen', '未测量'],
  unlisted: ['not in the list', 'nicht in der Liste', '不在词表中'],
  'doubt.unlisted': [
    'Warning: "{text}" is not in the list of {n} words that the server was measured with: what ' +
      'is shown may be something else.',
    'Achtung: „{text}“ ist nicht in der Liste der {n} Wörter, mit denen der Server gemessen ' +
      'wurde: was gezeigt wird, kann etwas anderes sein.',
    '注意：“{text}”不在服务器测量过的 {n} 个词之中：显示的可能是其他东西。',
  ],
  'doubt.poor': [
    'Warning: "{text}" is known poorly: much of it is missed, or much else is shown.',
    'Achtung: „{text}“ ist schlecht bekannt: vieles fehlt oder vieles andere wird gezeigt.',
    '注意：对“{text}”不熟悉：可能遗漏较多，或显示许多其他东西。',
  ],
  'doubt.unmeasured': [
    'How well "{text}" is known was not measured.',
    'Wie gut „{text}“ bekannt ist, wurde nicht gemessen.',
    '尚未测量对“{text}”的熟悉程度。',
  ],
  part: [
    'Fly to part {n}: {score} of {text}, {gaussians} Gaussians',
    'Zu Teil {n} fliegen: {score} von {text}, {gaussians} Gauß-Splats',
    '飞到第 {n} 处：{text} {score}，{gaussians} 个高斯',
  ],
  remove: ['Remove {text}', '{text} entfernen', '移除 {text}'],
  'word.take': [
    'Save the Gaussians of {text} as PLY',
    'Gauß-Splats von {text} als PLY speichern',
    '将 {text} 的高斯保存为 PLY',
  ],
  cut: ['At least', 'Mindestens', '至少'],
  'cut.title': [
    'The relevancy from which a place is shown',
    'Die Übereinstimmung, ab der eine Stelle gezeigt wird',
    '显示所需的最低相关度',
  ],
  thing: ['thing {n}', 'Ding {n}', '物体 {n}'],
  clicked: ['clicked', 'angeklickt', '已点选'],
  'pick.nothing': ['Nothing is there.', 'Dort ist nichts.', '那里什么也没有。'],
  'pick.like': [' This looks like: ', ' Das sieht aus wie: ', ' 看起来像：'],
  'pick.nameless': [
    'No name of the list fits.',
    'Kein Name der Liste passt.',
    '词表中没有合适的名称。',
  ],
  'pick.later': [
    'Names are known after the first word.',
    'Namen sind nach dem ersten Wort bekannt.',
    '查找第一个词之后才有名称。',
  ],
  'pick.far': ['{depth} from the camera.', '{depth} von der Kamera entfernt.', '距相机 {depth}。'],
  'pick.size': [
    '{wide} wide, {high} high, {deep} deep.',
    '{wide} breit, {high} hoch, {deep} tief.',
    '宽 {wide}，高 {high}，深 {deep}。',
  ],
  'pick.all': ['Find all of: {text}', 'Alle finden: {text}', '查找全部：{text}'],
  measure: ['Measure', 'Messen', '测量'],
  'measure.here': ['Measure from here', 'Von hier messen', '从这里测量'],
  'measure.first': ['Click two points.', 'Klicken Sie zwei Punkte an.', '请点击两个点。'],
  'measure.second': [
    'Now click the second point.',
    'Klicken Sie nun den zweiten Punkt an.',
    '现在点击第二个点。',
  ],
  'measure.is': [
    '{length} between the two points.',
    '{length} zwischen den beiden Punkten.',
    '两点之间为 {length}。',
  ],
  'measure.units': [
    '{length} units of the capture between the two points.',
    '{length} Einheiten der Aufnahme zwischen den beiden Punkten.',
    '两点之间为 {length} 个采集单位。',
  ],
  'measure.path': [
    '{length} along the points, {area} between them.',
    '{length} entlang der Punkte, {area} dazwischen.',
    '沿各点为 {length}，围成 {area}。',
  ],
  'measure.high': [
    'The last one is {height} over the ground.',
    'Der letzte liegt {height} über dem Boden.',
    '最后一点离地 {height}。',
  ],
  ground: ['Ground', 'Boden', '地面'],
  'scale.none': [
    'Lengths are in units of the capture: measure one and say its true length.',
    'Längen sind in Einheiten der Aufnahme: Messen Sie eine und geben Sie ihre wahre Länge an.',
    '长度以采集单位表示：测量一段并输入其实际长度。',
  ],
  'scale.capture': [
    'Lengths are in metres, as the capture measured them.',
    'Längen sind in Metern, wie die Aufnahme sie gemessen hat.',
    '长度以米为单位，由采集程序测得。',
  ],
  'scale.given': [
    'Lengths are in metres, by the length that was given.',
    'Längen sind in Metern, nach der Länge, die angegeben wurde.',
    '长度以米为单位，依据给定的长度。',
  ],
  'measure.truth': ['In truth it is', 'In Wahrheit sind es', '实际长度为'],

  // Edits.
  edits: ['Edits', 'Änderungen', '编辑'],
  'edits.none': [
    'Find or click a thing, then delete, move or recolour it.',
    'Finden Sie ein Ding oder klicken Sie es an; dann löschen, bewegen oder färben Sie es.',
    '查找或点击物体，然后删除、移动或改色。',
  ],
  'edits.doing': ['editing …', 'wird geändert …', '正在编辑…'],
  'edits.whole': [
    'The scene is as it was made.',
    'Die Szene ist so, wie sie entstand.',
    '场景已恢复原样。',
  ],
  'edits.hole': [
    'What was behind was not seen: {share} % of the photos shows nothing now.',
    'Was dahinter war, ist auf keinem Foto: {share} % der Fotos zeigen dort nun nichts.',
    '其后方未被拍到：照片中有 {share} % 现在没有内容。',
  ],
  holes: ['Holes', 'Löcher', '空洞'],
  'edits.box': ['Box', 'Quader', '框'],
  'edits.floaters': ['Clean', 'Säubern', '清理'],
  'edits.floaters.title': [
    'Delete floaters: what no photo confirms and several see through',
    'Schwebendes löschen: was kein Foto bestätigt und mehrere durchschauen',
    '删除漂浮物：没有照片证实且多张照片看穿的部分',
  ],
  'edits.up': ['Apply edit {n} earlier', 'Änderung {n} früher anwenden', '提前应用编辑 {n}'],
  'edits.down': ['Apply edit {n} later', 'Änderung {n} später anwenden', '推后应用编辑 {n}'],
  'edits.away': ['Take back edit {n}', 'Änderung {n} zurücknehmen', '撤回编辑 {n}'],
  undo: ['Undo', 'Rückgängig', '撤销'],
  redo: ['Redo', 'Wiederholen', '重做'],
  'edit.delete': ['Deleted: {what}', 'Gelöscht: {what}', '已删除：{what}'],
  'edit.keep': ['Kept alone: {what}', 'Allein behalten: {what}', '仅保留：{what}'],
  'edit.move': ['Moved: {what}', 'Bewegt: {what}', '已移动：{what}'],
  'edit.copy': ['Copied: {what}', 'Kopiert: {what}', '已复制：{what}'],
  'edit.recolor': ['Recoloured: {what}', 'Gefärbt: {what}', '已改色：{what}'],
  'edit.of.point': ['a clicked thing', 'ein angeklicktes Ding', '点选的物体'],
  'edit.of.pick': ['a clicked thing', 'ein angeklicktes Ding', '点选的物体'],
  'edit.of.box': ['a box', 'ein Quader', '一个框'],
  'edit.of.sphere': ['a ball', 'eine Kugel', '一个球'],
  'edit.of.floaters': ['floaters', 'Schwebendes', '漂浮物'],
  'act.on': ['Edit {text}', '{text} ändern', '编辑 {text}'],
  'act.parts': ['Which part', 'Welcher Teil', '哪一处'],
  'act.all': ['all of it', 'alles', '全部'],
  'act.part': ['part {n}', 'Teil {n}', '第 {n} 处'],
  'act.delete': ['Delete', 'Löschen', '删除'],
  'act.keep': ['Keep only this', 'Nur dies behalten', '仅保留'],
  'act.move': ['Move', 'Bewegen', '移动'],
  'act.recolor': ['Recolour', 'Färben', '改色'],
  'box.wide': ['Width', 'Breite', '宽'],
  'box.high': ['Height', 'Höhe', '高'],
  'box.deep': ['Depth', 'Tiefe', '深'],
  'move.right': ['To the right', 'Nach rechts', '向右'],
  'move.up': ['Up', 'Nach oben', '向上'],
  'move.away': ['Away', 'Nach hinten', '向远'],
  'move.turn': ['Turn', 'Drehen', '旋转'],
  'move.times': ['Times as large', 'Mal so groß', '放大倍数'],
  'move.copy': ['Copy there', 'Dorthin kopieren', '复制到此'],
  color: ['Colour', 'Farbe', '颜色'],
  amount: ['Strength', 'Stärke', '强度'],
  units: ['units', 'Einheiten', '单位'],

  // The view.
  'panel.view': ['View', 'Ansicht', '视图'],
  show: ['Show', 'Zeigen', '显示'],
  'kind.colour': ['colour', 'Farbe', '颜色'],
  'kind.depth': ['depth', 'Tiefe', '深度'],
  'kind.alpha': ['alpha', 'Deckkraft', '不透明度'],
  'kind.mask': ['mask', 'Maske', '掩码'],
  drag: ['Drag', 'Ziehen', '拖动'],
  'drag.orbit': ['orbit', 'kreisen', '环绕'],
  'drag.pan': ['pan', 'schieben', '平移'],
  'drag.look': ['look around', 'umsehen', '环视'],
  cameras: ['Cameras', 'Kameras', '相机'],
  strip: ['Photos to fly to', 'Fotos zum Anfliegen', '可飞往的照片'],
  keep: ['Keep view', 'Ansicht merken', '保存视角'],
  kept: ['Kept views', 'Gemerkte Ansichten', '已保存的视角'],
  'kept.go': ['Fly to kept view {n}', 'Zu Ansicht {n} fliegen', '飞到视角 {n}'],
  'kept.drop': ['Forget view {n}', 'Ansicht {n} vergessen', '移除视角 {n}'],

  // What leaves the page.
  'panel.take': ['Take with you', 'Mitnehmen', '导出'],
  share: ['Share link', 'Link teilen', '分享链接'],
  'share.done': [
    'The link is copied: it has the scene, the view and the words.',
    'Der Link ist kopiert: mit Szene, Ansicht und Wörtern.',
    '链接已复制：包含场景、视角和词。',
  ],
  'share.link': ['The link: {link}', 'Der Link: {link}', '链接：{link}'],
  picture: ['Picture', 'Bild', '图片'],
  vr: ['VR', 'VR', 'VR'],
  'vr.title': [
    'Show the scene in a headset',
    'Die Szene in einem Headset zeigen',
    '在头戴设备中显示场景',
  ],
  'vr.failed': [
    'The headset shows nothing: {why}',
    'Das Headset zeigt nichts: {why}',
    '头戴设备无法显示：{why}',
  ],
  film: ['Video', 'Video', '视频'],
  'film.motion': ['Motion', 'Bewegung', '运动'],
  'film.turn': ['once around', 'einmal herum', '环绕一周'],
  'film.swing': ['30° to and fro', '30° hin und her', '来回 30°'],
  'film.path': ['through kept views', 'durch gemerkte Ansichten', '经过已保存的视角'],
  'film.seconds': ['Seconds', 'Sekunden', '秒'],
  'film.side': ['Longer side', 'Längere Seite', '长边'],
  'film.says': [
    '{frames} frames of {width} × {height}, {rate} a second',
    '{frames} Bilder von {width} × {height}, {rate} pro Sekunde',
    '{frames} 帧，{width} × {height}，每秒 {rate} 帧',
  ],
  'film.most': [
    'up to {frames} frames of {width} × {height}, {rate} a second',
    'bis zu {frames} Bilder von {width} × {height}, {rate} pro Sekunde',
    '最多 {frames} 帧，{width} × {height}，每秒 {rate} 帧',
  ],
  'film.make': ['Make the video', 'Video erstellen', '制作视频'],
  'film.making': ['making the video …', 'das Video entsteht …', '正在制作视频…'],
  'film.done': [
    'The video is written: {size} MB.',
    'Das Video ist geschrieben: {size} MB.',
    '视频已写入：{size} MB。',
  ],
  'film.cancelled': ['The video is cancelled.', 'Das Video ist abgebrochen.', '视频已取消。'],
  'film.cannot': [
    'This browser can neither encode nor record video.',
    'Dieser Browser kann Video weder kodieren noch aufnehmen.',
    '此浏览器既不能编码也不能录制视频。',
  ],
  export: ['Export', 'Exportieren', '导出为'],
  'export.as': ['as …', 'als …', '格式…'],
  writing: ['writing the file …', 'die Datei wird geschrieben …', '正在写入文件…'],
  written: ['the file is written', 'die Datei ist geschrieben', '文件已写入'],
  embed: ['Embed', 'Einbetten', '嵌入'],
  'embed.how': [
    'Copy these lines into your page. The server must be started with the address of that page: ' +
      'segsplat serve --cors-origins ADDRESS',
    'Kopieren Sie diese Zeilen in Ihre Seite. Der Server muss mit deren Adresse gestartet sein: ' +
      'segsplat serve --cors-origins ADRESSE',
    '将以下内容复制到您的网页。服务器须以该网页的地址启动：segsplat serve --cors-origins 地址',
  ],
  'embed.file': [
    'Without a server: export the scene as one HTML file, put it beside your page, and give its ' +
      'name as src.',
    'Ohne Server: exportieren Sie die Szene als eine HTML-Datei, legen Sie sie neben Ihre Seite, ' +
      'und geben Sie ihren Namen als src an.',
    '无需服务器：将场景导出为单个 HTML 文件，放在网页旁，并以其文件名作为 src。',
  ],
  'embed.done': ['The lines are copied.', 'Die Zeilen sind kopiert.', '已复制。'],

  // About.
  'panel.about': ['About this scene', 'Über diese Szene', '关于此场景'],
  'about.file': [
    '{n} Gaussians of a file ({format})',
    '{n} Gauß-Splats einer Datei ({format})',
    '文件（{format}）中的 {n} 个高斯',
  ],
  'about.photos': [
    '{n} Gaussians of {used} of {photos} photos',
    '{n} Gauß-Splats aus {used} von {photos} Fotos',
    '{photos} 张照片中的 {used} 张生成 {n} 个高斯',
  ],
  gain: [
    'Refined: {from} → {to} dB on photos it did not see',
    'Verfeinert: {from} → {to} dB an nicht gesehenen Fotos',
    '已优化：未见照片上 {from} → {to} dB',
  ],
  refining: ['being refined: {share} %', 'wird verfeinert: {share} %', '优化中：{share} %'],
  before: ['Before', 'Vorher', '优化前'],
  better: ['A better version: {shown}', 'Eine bessere Fassung: {shown}', '更好的版本：{shown}'],
  'panel.help': ['Help', 'Hilfe', '帮助'],
  help: [
    'Drag turns, Shift and drag moves, Ctrl and drag looks around, the wheel goes nearer. ' +
      'One finger turns; two fingers move, and go nearer as they part. Arrow keys turn, with ' +
      'Shift they move; W A S D Q E fly, + and - go nearer and farther, Home is the first ' +
      'photo, N and P are the next and the previous one. A click selects the thing there, ' +
      'Shift and click one more, Escape lets go. Delete deletes what is selected, Ctrl and Z ' +
      'takes an edit back. / goes to the question, ? to this help.',
    'Ziehen dreht, mit Umschalt verschiebt es, mit Strg sieht man sich um, das Rad geht ' +
      'näher. Ein Finger dreht; zwei Finger verschieben, und gehen näher, wenn sie ' +
      'auseinandergehen. Pfeiltasten drehen, mit Umschalt verschieben sie; W A S D Q E ' +
      'fliegen, + und - gehen näher und weiter weg, Pos1 ist das erste Foto, N und P sind das ' +
      'nächste und das vorige. Ein Klick wählt das Ding dort, mit Umschalt eines dazu, Esc ' +
      'lässt los. Entf löscht das Gewählte, Strg und Z nimmt eine Änderung zurück. / geht zur ' +
      'Frage, ? zu dieser Hilfe.',
    '拖动旋转，Shift 加拖动平移，Ctrl 加拖动环视，滚轮靠近。单指旋转；双指平移，张开则靠近。' +
      '方向键旋转，加 Shift 平移；W A S D Q E 飞行，+ 和 - 靠近和远离，Home 回到第一张照片，' +
      'N 和 P 为下一张和上一张。点击选中该处物体，Shift 加点击再选一个，Esc 取消。Delete 删除所选，Ctrl 加 Z 撤销。' +
      '/ 转到提问，? 打开本帮助。',
  ],

  // What goes wrong.
  'server.gone': [
    'the server cannot be reached',
    'der Server ist nicht erreichbar',
    '无法连接服务器',
  ],
  'device.gone': [
    'The graphics device dropped the scene; it is loaded again when it is back.',
    'Das Grafikgerät hat die Szene verloren; sie wird neu geladen, sobald es zurück ist.',
    '图形设备丢失了场景；恢复后会重新加载。',
  ],
  'device.lost': ['The graphics device is lost.', 'Das Grafikgerät ist weg.', '图形设备已丢失。'],
  'device.old': [
    'this browser has no WebGL2 with float buffers; try a newer one',
    'dieser Browser hat kein WebGL2 mit Gleitkommapuffern; nehmen Sie einen neueren',
    '此浏览器没有支持浮点缓冲的 WebGL2；请换用更新的浏览器',
  ],
  'device.full': [
    'this device has no memory for a scene',
    'dieses Gerät hat keinen Speicher für eine Szene',
    '此设备没有足够的内存显示场景',
  ],
  'alone.knows': [
    'This file knows: {words}.',
    'Diese Datei kennt: {words}.',
    '此文件认识：{words}。',
  ],
  'alone.nothing': ['no words', 'keine Wörter', '没有词'],
  'alone.words': ['Words: {words}', 'Wörter: {words}', '词：{words}'],
};

// The index of the language, and its tag.
const language =
  navigator.languages.map((tag) => tag.split('-')[0]).find((tag) => LANGUAGES.includes(tag)) ||
  'en';

// What a key says with these values.
function t(key, values = {}) {
  const row = TABLE[key];
  if (!row) return key;
  const [one, many = one] = row[LANGUAGES.indexOf(language)].split('|');
  return (values.n === 1 ? one : many).replace(/\{(\w+)\}/g, (_, name) => values[name]);
}

// Writes the words of the document: data-t is the text of an element, data-t-label and so on an
// attribute.
function translate() {
  document.documentElement.lang = language;
  for (const node of document.querySelectorAll('[data-t]')) node.textContent = t(node.dataset.t);
  for (const [name, attribute] of [
    ['tLabel', 'aria-label'],
    ['tTitle', 'title'],
    ['tPlaceholder', 'placeholder'],
  ]) {
    const selector = `[data-${name.replace(/[A-Z]/, (c) => `-${c.toLowerCase()}`)}]`;
    for (const node of document.querySelectorAll(selector))
      node.setAttribute(attribute, t(node.dataset[name]));
  }
}
